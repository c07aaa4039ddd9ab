"""Reading effects back: every damage is named."""

from typing import Any

import pytest

from twin_core.effects import REGISTRY, effect_from_json
from twin_core.errors import SpecError

GOOD = {
    "effect": "leak_to_boundary",
    "where": {"node": "a", "boundary": "b"},
    "settings": {},
    "values": {"G_W_per_K": 1.0},
}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (None, r"effects\[3\]\.effect: unknown effect None"),
        ("leak", r"effects\[3\]\.effect: unknown effect 'leak'"),
        ({}, r"effects\[3\]\.effect: unknown effect None"),
        ({**GOOD, "effect": "leek"}, r"unknown effect 'leek' \(known: radiation_to_sink"),
        ({**GOOD, "where": {"node": "a"}}, r"where\.boundary is missing"),
        ({**GOOD, "where": {"node": 3, "boundary": "b"}}, r"where\.node must be a name"),
        ({**GOOD, "where": {"node": "a", "boundary": "b", "sink": "c"}}, r"where\.sink is not one of node, boundary"),
        ({**GOOD, "values": {}}, r"effects\[3\]\.values\.G_W_per_K: is missing"),
        ({**GOOD, "effect": "missing_conductor", "where": {"nodes": "ab"}}, r"where\.nodes must be a pair of nodes"),
        ({**GOOD, "effect": "missing_conductor", "where": {"nodes": ["a"]}}, r"where\.nodes must be a pair of nodes"),
    ],
)
def test_damage_is_named(data: Any, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        effect_from_json(data, 3)


def test_an_optional_key_may_follow() -> None:
    settings = {"degree": 0, "vanishing": False, "low_K": [280.0, 290.0], "high_K": [300.0, 295.0]}
    data = {
        "effect": "learned_heat_flow",
        "where": {"node": "a", "boundary": "room"},
        "settings": settings | {"misfit_W": 0.0, "covariance_W2": []},
        "values": {f"coefficients[{k}]": 1.0 for k in range(1)},
    }
    assert effect_from_json(data).label == "learned_heat_flow(a,room)"
    with pytest.raises(SpecError, match=r"where\.sink is not one of node, boundary"):
        effect_from_json(data | {"where": {"node": "a", "sink": "room"}})


def test_an_intact_effect_is_read() -> None:
    effect = effect_from_json(GOOD)
    assert isinstance(effect, REGISTRY["leak_to_boundary"])
    assert effect.label == "leak_to_boundary(a,b)"


def test_a_heat_without_a_name_is_tried_last() -> None:
    assert [name for name, kind in REGISTRY.items() if kind.fallback] == ["learned_heat_flow"]
