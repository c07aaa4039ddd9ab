"""Each rival finds an easy effect: benchmarks against straw men would prove nothing.

The truth is integrated by SciPy: two blocks over a sink, all parameters known, a heat that nobody declared.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

pytest.importorskip("pysindy", reason="the benchmarks' extra is not installed")

from benchmarks.case import Case, Truth
from benchmarks.loop_rivals import rivals_of
from benchmarks.rival_features import FeatureHeat, library, powers
from benchmarks.rival_residual import rms_error_K
from twin_core.holdout import split_fraction
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.network.terms import Along
from twin_core.telemetry import Record

ROOM_K, NOISE_K = 290.0, 0.01


@cache
def case() -> Case:
    """A block at 0.5 W/K to the room and one behind it, heated by switches; the second leaks 0.4 W/K undeclared."""
    time_s = np.arange(0.0, 40_000.0, 60.0)
    rng = np.random.default_rng(3)
    power = np.repeat(rng.choice([0.0, 20.0, 40.0], time_s.size // 25 + 1), 25)[: time_s.size]
    room = ROOM_K + 8.0 * np.sin(2 * np.pi * time_s / 9_000.0)

    def rates(t: float, x: np.ndarray, k: int) -> list[float]:
        air = np.interp(t, time_s, room)
        between = 1.5 * (x[1] - x[0])
        return [(power[k] + between + 0.5 * (air - x[0])) / 2000.0, (-between + 0.4 * (air - x[1])) / 3000.0]

    states = [np.array([295.0, 292.0])]
    for k in range(time_s.size - 1):
        run = solve_ivp(rates, (time_s[k], time_s[k + 1]), states[-1], args=(k,), rtol=1e-9, atol=1e-9)
        states.append(run.y[:, -1])
    truth = np.array(states)
    read = truth + NOISE_K * rng.normal(size=truth.shape)
    spec = load_spec(
        {
            "twin": "two-blocks",
            "boundaries": {"room": {"channel": "T_room"}},
            "channels": {
                **{name: {"kind": "temperature", "unit": "K"} for name in ("T_room", "T0", "T1")},
                "P0": {"kind": "power", "unit": "W"},
            },
            "nodes": [
                {"id": "n0", "capacity_J_per_K": {"value": 2000.0}, "sensor": "T0"},
                {"id": "n1", "capacity_J_per_K": {"value": 3000.0}, "sensor": "T1"},
            ],
            "conductors": [
                {"between": ["n0", "n1"], "conductance_W_per_K": {"value": 1.5}},
                {"between": ["n0", "room"], "conductance_W_per_K": {"value": 0.5}},
            ],
            "loads": [{"channel": "P0", "node": "n0"}],
        }
    )
    values = {"T_room": room, "T0": read[:, 0], "T1": read[:, 1], "P0": power}
    leak = Truth("leak_to_boundary", {"node": "n1", "boundary": "room"})
    return Case(spec, Record(time_s, values, None, "two-blocks"), (leak,), truth, NOISE_K)


@pytest.mark.parametrize("name", ["SINDy", "greedy BIC"])
def test_rival_names_an_easy_effect_and_predicts_with_it(name: str) -> None:
    answer, _ = rivals_of(case())[name]()
    assert answer.named[0] == {"effect": "leak_to_boundary", "where": {"node": "n1", "boundary": "room"}}
    _, held = split_fraction([case().record], 0.3)
    assert rms_error_K(answer.model, held) < 3.0 * NOISE_K


def test_sindy_regresses_the_true_conductance() -> None:
    answer, _ = rivals_of(case())["SINDy"]()
    heat = next(e for e in answer.model.effects if e.where == {"node": "n1"})
    weights = dict(zip((f.effect for f in heat.settings["features"]), heat.settings["weights"], strict=True))
    assert weights["leak_to_boundary"] == pytest.approx(0.4, rel=0.05)


def test_residual_polynomial_brings_the_held_out_error_down() -> None:
    rivals = rivals_of(case())
    _, held = split_fraction([case().record], 0.3)
    errors = [rms_error_K(rivals[name]()[0].model, held) for name in ("residual polynomial", "before")]
    assert errors[0] < 0.9 * errors[1]


def test_slopes_of_every_feature_are_its_central_differences() -> None:
    network = build_network(case().spec)
    rng = np.random.default_rng(0)
    along = Along(
        np.linspace(0.0, 5e3, 7),
        rng.uniform(280.0, 300.0, (7, 2)),
        rng.uniform(280.0, 300.0, (7, 1)),
        {"P0": rng.uniform(0.0, 40.0, 7)},
        np.ones(7),
    )
    features = [*library(network.layout, "n1", {}, 3e3), *powers(1, 285.0, 295.0, 3)]
    weights = rng.normal(size=len(features))
    effect = FeatureHeat({"node": "n1"}, {}, {"features": features, "weights": weights, "offset_W": 2.0})
    (term,) = effect.addition(network.layout).terms
    slope = term.evaluate(along, np.zeros(0)).d_temperature
    for node in range(2):
        up, down = (along.temperatures_K + sign * 1e-3 * np.eye(2)[node] for sign in (1.0, -1.0))
        heats = [term.evaluate(replace(along, temperatures_K=t), np.zeros(0)).heat_W for t in (up, down)]
        assert slope[:, :, node] == pytest.approx((heats[0] - heats[1]) / 2e-3, rel=1e-5, abs=1e-6)
