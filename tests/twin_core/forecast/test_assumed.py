"""Forecasts without a plan: what is assumed, what it gives in closed form, and what bands make of what it missed."""

from typing import Any

import numpy as np
import pytest

from tests.helpers import conductive_spec, model_of, record_of
from twin_core.calibrate.result import CalibratedModel
from twin_core.errors import ModelError
from twin_core.forecast import forecast
from twin_core.forecast.assumed import Past, Rule, assume
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

POWER = {"kind": "power", "unit": "W"}
CAPACITY_J_PER_K, NOISE_K, STEP_S = 5.0e3, 0.1, 60.0
PERIOD_S, ON_S, POWER_W = 5400.0, 1800.0, 20.0


def integrator(**channels: dict[str, Any]) -> CalibratedModel:
    """One node and its heats: an integrator, whose forecast is a sum."""
    loads = [{"channel": name, "node": "n0"} for name, c in channels.items() if c["kind"] == "power"]
    spec = load_spec(conductive_spec(1, [], channels=channels, loads=loads))
    return model_of(spec, {"C:n0": CAPACITY_J_PER_K}, noise_K=NOISE_K)


def ahead(model: CalibratedModel, past: Record, horizon_s: float, **more: Any) -> Any:
    """Forecast from 290 K, known exactly, at the end of a past."""
    now_s = float(past.time_s[-1])
    state = {"time_s": now_s, "nodes": ["n0"], "mean_K": [290.0], "covariance_K2": [[0.0]]}
    last = past.take(np.array([past.time_s.size - 1]))
    return forecast(model, last, horizon_s, step_s=STEP_S, past=past, state=state, **more)


def wave(time_s: np.ndarray) -> np.ndarray:
    return np.where(time_s % PERIOD_S < ON_S, POWER_W, 0.0)


def test_a_periodic_input_goes_on_and_another_holds() -> None:
    """The heat that comes again is integrated by hand, to the J."""
    time_s = STEP_S * np.arange(1000.0)  # it ends 8.3 cycles on, in the middle of an off part
    past = record_of(time_s, T0=290.0, Q=wave(time_s), P=7.0)
    found = ahead(integrator(Q=POWER, P=POWER), past, 2.0 * PERIOD_S)
    assert found.inputs == {"Q": "repeat", "P": "hold"}
    assert any("Q repeats its last 5400" in notice and "P" not in notice.split(":")[1] for notice in found.notices)
    now_s = time_s[-1]
    fine = now_s + np.arange(0.5, 2.0 * PERIOD_S)
    heat_J = np.cumsum(wave(fine) + 7.0)[np.rint(found.time_s - now_s).astype(int) - 1]
    np.testing.assert_allclose(found.mean_K[:, 0] - 290.0, heat_J / CAPACITY_J_PER_K, atol=0.02)
    sure = ahead(integrator(Q=POWER, P=POWER), past, 2.0 * PERIOD_S, plan=record_of(time_s[-1:], Q=0.0, P=7.0))
    np.testing.assert_allclose(np.ptp(found.quantiles_K[0.95] - found.mean_K), 0.0, atol=0.02)
    assert sure.inputs == {"Q": "plan", "P": "plan"} and sure.notices == ()


def test_held_bands_contain_what_the_input_did_before() -> None:
    """A heater that is switched at random: the share of readings inside is that of the band, where a held one misses."""
    rng = np.random.default_rng(2)
    n, n_ahead, inside, naive = 4000, 60, [], []
    power = np.repeat(rng.choice([0.0, 30.0], n), rng.poisson(30, n) + 5)[: n + n_ahead]
    time_s = STEP_S * np.arange(n + n_ahead, dtype=float)
    model = integrator(Q=POWER)
    for cut in range(1500, n, 83):
        past = record_of(time_s[:cut], T0=290.0, Q=power[:cut])
        found = ahead(model, past, n_ahead * STEP_S)
        assert found.inputs == {"Q": "hold"}
        truth = 290.0 + np.cumsum(power[cut - 1 : cut - 1 + n_ahead]) * STEP_S / CAPACITY_J_PER_K
        read = truth + rng.normal(0.0, NOISE_K, n_ahead)
        low, high = found.quantiles_K[0.05][:, 0], found.quantiles_K[0.95][:, 0]
        inside.append((read >= low) & (read <= high))
        held_K = 290.0 + power[cut - 1] * (found.time_s - found.time_s[0] + STEP_S) / CAPACITY_J_PER_K
        naive.append(np.abs(read - held_K) <= 1.645 * NOISE_K)
    assert 0.82 <= np.mean(inside) <= 0.97, np.mean(inside)
    assert np.mean(naive) < 0.6


def test_what_a_held_input_missed_is_the_same_heat_whatever_the_steps() -> None:
    """Edges that lie within a step count with their share of it: an integrator tells heats apart to the J."""
    rng = np.random.default_rng(5)
    time_s = STEP_S * np.arange(900.0)
    power = np.repeat(rng.choice([0.0, 30.0], 300), rng.poisson(9, 300) + 1)[:900]
    past = record_of(time_s, T0=290.0, Q=power)
    found = ahead(integrator(Q=POWER), past, 2.0 * PERIOD_S, inputs="hold")
    fine = forecast_in_steps(past, 7.5)
    assert fine.time_s[7] == found.time_s[0]
    np.testing.assert_allclose(found.mean_K, fine.mean_K[7::8], atol=1e-6)
    for q, quantile_K in found.quantiles_K.items():  # of a mixture: between members far apart it is hardly determined
        assert np.median(np.abs(quantile_K - fine.quantiles_K[q][7::8])) < 1e-6


def forecast_in_steps(past: Record, step_s: float) -> Any:
    state = {"time_s": past.time_s[-1], "nodes": ["n0"], "mean_K": [290.0], "covariance_K2": [[0.0]]}
    last = past.take(np.array([past.time_s.size - 1]))
    options = {"step_s": step_s, "past": past, "state": state, "inputs": "hold"}
    return forecast(integrator(Q=POWER), last, 2.0 * PERIOD_S, **options)


@pytest.mark.parametrize("period_s", [None, 700.0])
def test_the_integral_of_what_is_assumed_is_that_of_its_values(period_s: float | None) -> None:
    """Riemann sums of a second, over several periods."""
    time_s = 10.0 * np.arange(200.0)
    rule = Rule(Past(time_s, np.random.default_rng(0).normal(size=200), True), period_s)
    origin_s, lead_s = np.array([[1203.0], [1990.0]]), np.arange(1.0, 2500.0, 1.0)
    sums = np.cumsum(rule.ahead(origin_s, lead_s - 0.5), axis=1)
    np.testing.assert_allclose(rule.integral_ahead(origin_s, lead_s), sums, atol=1e-6)


def test_without_a_past_an_input_holds_and_nothing_is_said() -> None:
    past = record_of(np.array([600.0]), T0=290.0, Q=10.0)
    found = ahead(integrator(Q=POWER), past, 600.0)
    assert found.inputs == {"Q": "hold"} and found.notices == ()
    np.testing.assert_allclose(found.mean_K[-1, 0], 290.0 + 10.0 * 600.0 / CAPACITY_J_PER_K)


def test_the_three_ways() -> None:
    spec = integrator(Q=POWER, P=POWER, mode={"kind": "auxiliary", "levels": True}).spec
    time_s = STEP_S * np.arange(1000.0)
    random = np.random.default_rng(0).normal(size=1000)
    past = record_of(time_s, Q=wave(time_s), P=random, mode=np.nan)
    ways = {how: assume(spec, past, None, how) for how in ("auto", "repeat", "hold")}  # type: ignore[arg-type]
    assert ways["auto"].how == {"Q": "repeat", "P": "hold", "mode": "hold"}
    assert ways["repeat"].how == {"Q": "repeat", "P": "repeat", "mode": "hold"}
    assert ways["repeat"].rules["P"].period_s == ways["repeat"].rules["Q"].period_s
    assert ways["hold"].how == dict.fromkeys(("Q", "P", "mode"), "hold")
    with pytest.raises(ModelError, match="inputs: must be auto, repeat or hold"):
        assume(spec, past, None, "guess")  # type: ignore[arg-type]


def test_a_boundary_and_a_mode_are_repeated_too() -> None:
    """The room's temperature swings, the mode keeps to its levels."""
    body = conductive_spec(
        1,
        [],
        channels={"T_room": {"kind": "temperature", "unit": "K"}, "mode": {"kind": "auxiliary", "levels": True}},
        boundaries={"room": {"channel": "T_room"}},
    )
    body["conductors"] = [{"between": ["n0", "room"], "conductance_W_per_K": {"value": 5.0}}]
    model = model_of(load_spec(body), {"C:n0": CAPACITY_J_PER_K}, noise_K=NOISE_K)
    time_s = STEP_S * np.arange(900.0)
    past = record_of(
        time_s, T0=290.0, T_room=290.0 + 5.0 * np.sin(2.0 * np.pi * time_s / PERIOD_S), mode=wave(time_s) / POWER_W
    )
    found = ahead(model, past, PERIOD_S)
    assert found.inputs == {"T_room": "repeat", "mode": "repeat"}
    assert np.ptp(found.mean_K) > 2.0  # a first-order lag of 1000 s passes 5 K / hypot(1, 1.16)
    held = ahead(model, past, PERIOD_S, inputs="hold")
    assert held.inputs == {"T_room": "hold", "mode": "hold"}
    assert (held.whole_K[1] >= held.quantiles_K[0.95]).all() and (held.whole_K[0] <= held.quantiles_K[0.05]).all()


def test_a_planned_channel_is_not_made_unsure() -> None:
    time_s = STEP_S * np.arange(1000.0)
    power = np.random.default_rng(0).choice([0.0, 30.0], 1000)
    past = record_of(time_s, T0=290.0, Q=power)
    plan = record_of(time_s[-1] + np.array([0.0, 600.0]), Q=np.array([5.0, 0.0]))
    found = ahead(integrator(Q=POWER), past, 1200.0, plan=plan)
    assert found.inputs == {"Q": "plan"}
    np.testing.assert_allclose(found.quantiles_K[0.95] - found.mean_K, 1.6449 * NOISE_K, rtol=1e-3)
