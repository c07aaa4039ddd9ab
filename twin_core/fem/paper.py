"""The benchmark problem of the LPTM paper (arXiv 2605.28452, sections 5.1 to 5.5), and the network that is fitted to it.

The domain is [0, 2]^2 m, 64 x 64 bilinear cells (4225 unknowns), three monitored subsystems and an isolated one in a
plate whose four sides radiate through insulation and receive sun. The paper gives neither materials nor amplitudes;
those below were chosen by us: smeared densities of real structures, temperatures within 200 to 400 K.
"""

from typing import Any

import numpy as np

from twin_core.constants import DEEP_SPACE_K
from twin_core.errors import SpecError
from twin_core.fem.scenario import Scenario, load_scenario
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec

CORRELATION_LENGTH_S = {"A": 700.0, "B": 840.0, "C": 560.0}
"""Correlation length of the internal sources of each test (section 5.2)."""

CONFIGURATIONS = {"external": ("sun",), "internal": ("heater",), "combined": ("sun", "heater")}
"""What drives each configuration: tables 1, 2 and 3."""

ORBIT_S = 6000.0
"""About 100 minutes (section 5.3)."""

EMISSIVITY = 0.35
"""Effective emissivity of sides behind insulation (section 5: "a strongly insulating layer")."""

N_EDGES = 28
"""With nine capacities they make the paper's 37 parameters (section 5.7)."""

MATERIALS: dict[str, dict[str, float]] = {
    # Sandwich with 1 mm face sheets of pitch-fibre laminate (in-plane 300 W/m/K) on a 20 mm core, smeared.
    "sandwich": {"conductivity_W_per_m_K": 30.0, "density_kg_per_m3": 230.0, "specific_heat_J_per_kg_K": 900.0},
    # Equipment bays, aluminium frames filled to a tenth, boards smeared.
    "bay": {"conductivity_W_per_m_K": 25.0, "density_kg_per_m3": 350.0, "specific_heat_J_per_kg_K": 900.0},
    "cells": {"conductivity_W_per_m_K": 20.0, "density_kg_per_m3": 450.0, "specific_heat_J_per_kg_K": 960.0},
    "propellant": {"conductivity_W_per_m_K": 15.0, "density_kg_per_m3": 300.0, "specific_heat_J_per_kg_K": 2400.0},
    # Polyimide foam: isolates.
    "foam": {"conductivity_W_per_m_K": 0.045, "density_kg_per_m3": 50.0, "specific_heat_J_per_kg_K": 1090.0},
}

_REGIONS: dict[str, tuple[tuple[float, float], tuple[float, float], str]] = {
    "plate": ((0.0, 2.0), (0.0, 2.0), "sandwich"),
    "payload": ((0.3125, 0.8125), (1.1875, 1.6875), "bay"),
    "battery": ((1.1875, 1.6875), (1.1875, 1.6875), "cells"),
    "tank": ((1.1875, 1.6875), (0.3125, 0.8125), "propellant"),
    "isolated": ((0.375, 0.75), (0.375, 0.75), "foam"),
}

SENSORS: dict[str, tuple[float, float]] = {
    "left": (0.0, 1.0),
    "right": (2.0, 1.0),
    "bottom": (1.0, 0.0),
    "top": (1.0, 2.0),
    "payload_1": (0.4375, 1.4375),
    "payload_2": (0.6875, 1.4375),
    "battery_1": (1.3125, 1.4375),
    "battery_2": (1.5625, 1.4375),
    "tank_1": (1.4375, 0.5625),
}
"""Nine point sensors: one on each side, the others in the monitored subsystems."""

_SIDES = ("left", "right", "bottom", "top")
_PHASE_DEG = {"top": 0.0, "right": 90.0, "bottom": 180.0, "left": 270.0}
_SIDE_LENGTH_M = 2.0


def paper_scenario(
    test: str = "A",
    configuration: str = "combined",
    *,
    seed: int = 0,
    noise_fraction: float = 0.0,
    duration_s: float = 15.0 * ORBIT_S,
    sample_s: float = 20.0,
    scheme: str = "sdirk2",
) -> Scenario:
    """Return one of the paper's test cases.

    Parameters
    ----------
    test
        "A", "B" or "C": correlation length of the internal sources.
    configuration
        "external" (table 1), "internal" (table 2) or "combined" (table 3).
    seed
        Draws sources and noise.
    noise_fraction
        Standard deviation of the noise as a fraction of the mean temperature, taken as 300 K (table 5: 0.01, 0.05).

    Raises
    ------
    SpecError
        If test or configuration is not one of them.
    """
    if test not in CORRELATION_LENGTH_S:
        raise SpecError(f"test: unknown test '{test}' (known: {', '.join(CORRELATION_LENGTH_S)})")
    if configuration not in CONFIGURATIONS:
        raise SpecError(f"configuration: unknown '{configuration}' (known: {', '.join(CONFIGURATIONS)})")
    active = CONFIGURATIONS[configuration]
    return load_scenario(
        {
            "scenario": f"paper-{test.lower()}-{configuration}",
            "seed": seed,
            "mesh_size_m": 2.0 / 64.0,
            "initial_K": 290.0,
            "time": {
                "duration_s": duration_s,
                "step_s": sample_s,
                "sample_s": sample_s,
                "settle_s": 2.0 * ORBIT_S,
                "scheme": scheme,
            },
            "materials": MATERIALS,
            "regions": [{"id": n, "x_m": x, "y_m": y, "material": m} for n, (x, y, m) in _REGIONS.items()],
            "boundaries": {"space": {"value_K": DEEP_SPACE_K}},
            "radiators": [{"surface": side, "emissivity": EMISSIVITY, "sink": "space"} for side in _SIDES],
            "forcings": _forcings(active, CORRELATION_LENGTH_S[test]),
            "loads": _loads(),
            "sensors": [
                {"channel": f"T_{name}", "at_m": place, "noise_std_K": 300.0 * noise_fraction}
                for name, place in SENSORS.items()
            ],
        }
    )


def _forcings(active: tuple[str, ...], correlation_length_s: float) -> dict[str, Any]:
    """Return sun on four sides and two internal sources; what does not act is constant: what keeps it at 200-400 K."""
    forcings: dict[str, Any] = {}
    for side in _SIDES:
        signal: dict[str, Any] = {"signal": "constant", "value": 0.0}
        if "sun" in active:
            signal = {"signal": "sun", "peak": 1200.0, "period_s": ORBIT_S, "phase_deg": _PHASE_DEG[side]}
            signal["eclipse_deg"] = 120.0
        forcings[f"Q_{side}"] = {"kind": "power", "unit": "W", "interpolation": "linear", "signal": signal}
    for unit, mean_W in (("payload", 450.0), ("battery", 350.0)):
        signal = {"signal": "constant", "value": 0.0}
        if "heater" in active:
            length = {"correlation_length_s": correlation_length_s}
            signal = {"signal": "gaussian_process", "mean": mean_W, "std": 0.6 * mean_W, "minimum": 0.0} | length
        forcings[f"Q_{unit}"] = {"kind": "power", "unit": "W", "interpolation": "linear", "signal": signal}
    return forcings


def _loads() -> list[dict[str, str]]:
    sides = [{"forcing": f"Q_{side}", "place": side} for side in _SIDES]
    return sides + [{"forcing": f"Q_{unit}", "place": unit} for unit in ("payload", "battery")]


def paper_spec(*, guesses: bool = True) -> TwinSpec:
    """Return the network of figure 2: nine nodes, the 28 shortest connections, known radiation on the four sides.

    Parameters
    ----------
    guesses
        Whether to give rough guesses: an even share of the heat capacity, a plate's conductance of one square.
    """
    total = _total_capacity_J_per_K()
    capacity = {"capacity_J_per_K": {"guess": float(f"{total / len(SENSORS):.2g}")}} if guesses else {}
    conductance = {"conductance_W_per_K": {"guess": 10.0}} if guesses else {}
    sides = [{"channel": f"Q_{side}", "node": side} for side in _SIDES]
    shared = [
        {"channel": f"Q_{unit}", "node": f"{unit}_{i}", "weight": 0.5}
        for unit in ("payload", "battery")
        for i in (1, 2)
    ]
    temperatures = {f"T_{name}": {"kind": "temperature", "unit": "K"} for name in SENSORS}
    powers = {
        f"Q_{name}": {"kind": "power", "unit": "W", "interpolation": "linear"}
        for name in (*_SIDES, "payload", "battery")
    }
    return load_spec(
        {
            "twin": "paper",
            "boundaries": {"space": {"value_K": DEEP_SPACE_K}},
            "channels": temperatures | powers,
            "nodes": [{"id": name, "sensor": f"T_{name}"} | capacity for name in SENSORS],
            "conductors": [{"between": pair} | conductance for pair in _shortest_pairs(N_EDGES)],
            "radiators": [
                {"node": side, "emissivity": EMISSIVITY, "area_m2": _SIDE_LENGTH_M, "sink": "space"} for side in _SIDES
            ],
            "loads": sides + shared,
        }
    )


def _shortest_pairs(count: int) -> list[tuple[str, str]]:
    """Return the closest pairs of sensors, ties in the order of the names."""
    names = list(SENSORS)
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    lengths = [float(np.hypot(*np.subtract(SENSORS[a], SENSORS[b]))) for a, b in pairs]
    order = sorted(range(len(pairs)), key=lambda i: (round(lengths[i], 9), pairs[i]))
    return [pairs[i] for i in sorted(order[:count])]


def _total_capacity_J_per_K() -> float:
    """Return the heat capacity of the whole section, one metre deep."""

    def volumetric(material: str) -> float:
        return MATERIALS[material]["density_kg_per_m3"] * MATERIALS[material]["specific_heat_J_per_kg_K"]

    plate = volumetric("sandwich")
    inside = [
        (x[1] - x[0]) * (y[1] - y[0]) * (volumetric(m) - plate) for n, (x, y, m) in _REGIONS.items() if n != "plate"
    ]
    return _SIDE_LENGTH_M**2 * plate + sum(inside)
