"""Scenarios for the simulator's tests."""

from collections.abc import Callable
from typing import Any

import pytest

Maker = Callable[..., dict[str, Any]]


def make_two_plates(**changes: Any) -> dict[str, Any]:
    """Return two copper plates joined by a contact, each so conductive that one temperature stands for it.

    ``a`` radiates to 3 K, ``b`` couples to a boundary at 300 K; heat of 20 W into ``a`` holds; ``c`` stands alone.
    """
    body: dict[str, Any] = {
        "scenario": "two-plates",
        "mesh_size_m": 0.1,
        "initial_K": 290.0,
        "time": {"duration_s": 6000, "step_s": 20, "sample_s": 20},
        "materials": {
            "ideal": {"conductivity_W_per_m_K": 4e4, "density_kg_per_m3": 1000.0, "specific_heat_J_per_kg_K": 1000.0}
        },
        "regions": [
            {"id": "a", "x_m": [0, 0.1], "y_m": [0, 0.2], "material": "ideal"},
            {"id": "b", "x_m": [0.1, 0.3], "y_m": [0, 0.2], "material": "ideal"},
            {"id": "c", "x_m": [0.5, 0.6], "y_m": [0, 0.2], "material": "ideal"},
        ],
        "joints": [{"between": ["a", "b"], "conductance_W_per_m2_K": 50.0}],
        "boundaries": {"space": {"value_K": 3.0}, "room": {"value_K": 300.0}},
        "radiators": [{"surface": "a.left", "emissivity": 0.8, "sink": "space"}],
        "couplings": [{"place": "b", "boundary": "room", "conductance_W_per_K": 3.0}],
        "forcings": {
            "Q": {"kind": "power", "unit": "W", "signal": {"signal": "constant", "value": 20.0}},
            "mode": {
                "kind": "auxiliary",
                "levels": True,
                "signal": {"signal": "table", "time_s": [0, 2000], "values": [0, 2], "held": True},
            },
        },
        "loads": [{"forcing": "Q", "place": "a"}],
        "sensors": [{"channel": f"T_{name}", "region": name} for name in "abc"],
    }
    return body | changes


@pytest.fixture
def two_plates() -> Maker:
    """Return the maker of two plates; its keyword arguments replace fields."""
    return make_two_plates
