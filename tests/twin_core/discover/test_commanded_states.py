"""The closed loop on a flight like those of observatories: attitude steers sunlight, an instrument's position shades it.

SciPy integrates a box that reads in steps of a quarter of a kelvin, and a panel that nobody reads.
"""

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.closed_loop import ClosedLoop, close_loop
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

SPEC: dict[str, Any] = {
    "twin": "observatory",
    "boundaries": {"environment": {"guess_K": 250}},
    "channels": {
        "T_box": {"kind": "temperature", "unit": "K"},
        "P": {"kind": "power", "unit": "W"},
        "pitch": {"kind": "auxiliary", "unit": "deg"},
        "position": {"kind": "auxiliary", "levels": True},
    },
    "nodes": [
        {"id": "box", "sensor": "T_box", "capacity_J_per_K": {"guess": 1.0e4}},
        {"id": "panel", "capacity_J_per_K": {"guess": 5.0e4}},
    ],
    "conductors": [
        {"between": ["box", "panel"], "conductance_W_per_K": {"guess": 2.0}},
        {"between": ["panel", "environment"], "conductance_W_per_K": {"guess": 1.0}},
    ],
    "loads": [
        {"channel": "P", "node": "box", "gain": {"guess": 0.7}},
        {"channel": "pitch", "node": "panel", "table": {"knots": [45, 90, 130, 175]}},
    ],
}
STEP_S, RESOLUTION_K = 600.0, 0.25
KNOTS = np.array([45.0, 90.0, 130.0, 175.0])
SUNLIT_W = {0.0: [90.0, 110.0, 60.0, 20.0], 1.0: [90.0, 20.0, 40.0, 70.0], 2.0: [60.0, 110.0, 85.0, 20.0]}
"""Position -> heat at the knots of pitch: not a heat of its own, but another share of the sunlight at each attitude."""


def flight(n_times: int, seed: int, *, shaded: bool) -> Record:
    """Return a flight, with a maneuver every six hours or so and a move of the instrument every half day or so."""
    rng = np.random.default_rng(seed)

    def held(values: np.ndarray, length: int) -> np.ndarray:
        return np.repeat(values, rng.integers(length // 2, 2 * length, values.size))[:n_times]

    pitch = held(rng.uniform(45.0, 175.0, n_times // 8), 30)
    position = held(rng.choice([0.0, 1.0, 2.0], n_times // 20, p=[0.5, 0.3, 0.2]), 60)
    power = held(rng.uniform(20.0, 75.0, n_times // 10), 40)
    tables = {p: SUNLIT_W[p if shaded else 0.0] for p in SUNLIT_W}
    sun = np.array([np.interp(x, KNOTS, tables[p]) for x, p in zip(pitch, position, strict=True)])
    state, box = np.array([290.0, 285.0]), []
    for p, s in zip(power, sun, strict=True):
        box.append(state[0])

        def rates(t: float, x: np.ndarray, p: float = p, s: float = s) -> list[float]:
            across = 1.6 * (x[0] - x[1])
            return [(0.8 * p - across) / 8.0e3, (s + across - 1.9 * (x[1] - 240.0)) / 4.0e4]

        state = solve_ivp(rates, (0.0, STEP_S), state, rtol=1e-7, atol=1e-6).y[:, -1]
    values = {"T_box": RESOLUTION_K * np.round(np.array(box) / RESOLUTION_K)}
    values |= {"P": power, "pitch": pitch, "position": position}
    return Record(STEP_S * np.arange(n_times), values, None, f"flight-{seed}")


@cache
def solved(shaded: bool) -> ClosedLoop:
    """Return the closed loop on one flight, judged on another."""
    n_times = 1600 if shaded else 2400  # what is there shows in less than what is not there needs
    train, later = flight(n_times, 1, shaded=shaded), flight(n_times // 2, 2, shaded=shaded)
    return close_loop(load_spec(SPEC), [train], holdout_records=[later])


@pytest.mark.long
def test_a_position_that_shades_is_found_and_told_over_pitch() -> None:
    report = solved(True).report
    first = report["findings"][0]
    assert (first["effect"], first["where"]["channel"]) == ("channel_heat_load", "position")
    assert first["where"]["node"] == "panel"
    assert first["parameters"]["across"]["mean"] == "pitch"
    told = first["parameters"]
    lengths = {len(told[name]["mean"]) for name in ("knots", "states", "values_W")}
    assert len(lengths) == 1 and set(told["states"]["mean"]) == {1.0, 2.0}


@pytest.mark.long
def test_the_next_flight_is_predicted_to_the_resolution() -> None:
    report = solved(True).report
    assert report["before"]["rmse_K"] > 2.0
    assert report["after"]["rmse_K"] < 2.0 * RESOLUTION_K


@pytest.mark.long
def test_what_a_position_adds_is_told_within_its_uncertainty() -> None:
    told = solved(True).report["findings"][0]["parameters"]
    cells = zip(
        told["states"]["mean"], told["knots"]["mean"], told["values_W"]["mean"], told["values_W"]["std"], strict=True
    )
    for state, knot, mean, std in cells:
        expected = float(np.interp(knot, KNOTS, SUNLIT_W[state]) - np.interp(knot, KNOTS, SUNLIT_W[0.0]))
        assert abs(mean - expected) < 4.0 * std + 0.2 * abs(expected) + 2.0


@pytest.mark.long
def test_a_position_that_does_nothing_is_not_named() -> None:
    assert solved(False).report["verdict"] == "no_effect_supported"
