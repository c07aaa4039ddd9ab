"""Forecasts against closed forms, their plans, and the coverage of their bands on spacecraft that SciPy simulated."""

import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import norm

from benchmarks.network_cases import network_case
from tests.helpers import conductive_spec, model_of, record_of
from twin_core.assimilate import FLOOR_SHARE, assimilate
from twin_core.calibrate import calibrate
from twin_core.calibrate.result import CalibratedModel
from twin_core.effects.learned_heat_flow import LearnedHeatFlow
from twin_core.errors import ArgumentError, ModelError, TelemetryError
from twin_core.forecast import forecast
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

POWER = {"kind": "power", "unit": "W"}
CAPACITY_J_PER_K, NOISE_K = 5.0e3, 0.2
NOW_S = 600.0


def lone_node(kind: dict = POWER) -> dict:
    """One node and its heat: an integrator, whose forecast is a sum."""
    return conductive_spec(1, [], channels={"Q": kind}, loads=[{"channel": "Q", "node": "n0"}])


def integrator(kind: dict = POWER, **more: float) -> CalibratedModel:
    return model_of(load_spec(lone_node(kind)), {"C:n0": CAPACITY_J_PER_K}, **({"noise_K": NOISE_K} | more))


def known_start(mean_K: float = 290.0, std_K: float = 0.0) -> dict:
    """Return a state of the last sample, so that nothing is left to filter."""
    return {"time_s": NOW_S, "nodes": ["n0"], "mean_K": [mean_K], "covariance_K2": [[std_K**2]]}


def now(power_W: float = 10.0) -> Record:
    return record_of(np.array([NOW_S]), T0=290.0, Q=power_W)


def test_inputs_without_a_plan_hold_their_last_value() -> None:
    found = forecast(integrator(), now(10.0), 1000.0, step_s=100.0, state=known_start())
    np.testing.assert_allclose(found.time_s, NOW_S + 100.0 * np.arange(1, 11))
    np.testing.assert_allclose(found.mean_K[:, 0], 290.0 + 10.0 * 100.0 * np.arange(1, 11) / CAPACITY_J_PER_K)
    assert (found.sensors, found.present_K.tolist()) == (("T0",), [290.0])


def test_a_plan_is_honoured_between_the_forecasts_own_times() -> None:
    """The heat of a plan that switches within a step arrives in full: 250 s at 40 W, then nothing."""
    plan = record_of(NOW_S + np.array([50.0, 300.0]), Q=np.array([40.0, 0.0]))
    found = forecast(integrator(), now(10.0), 600.0, step_s=200.0, plan=plan, state=known_start())
    heat_J = np.array([50.0 * 10.0 + 150.0 * 40.0, 50.0 * 10.0 + 250.0 * 40.0, 50.0 * 10.0 + 250.0 * 40.0])
    np.testing.assert_allclose(found.time_s, NOW_S + np.array([200.0, 400.0, 600.0]))
    np.testing.assert_allclose(found.mean_K[:, 0], 290.0 + heat_J / CAPACITY_J_PER_K, rtol=1e-9)


def test_an_interpolated_plan_is_a_ramp() -> None:
    linear = {"kind": "power", "unit": "W", "interpolation": "linear"}
    plan = record_of(NOW_S + np.array([0.0, 1000.0]), Q=np.array([0.0, 50.0]))
    found = forecast(integrator(linear, max_step_s=20.0), now(), 1000.0, step_s=100.0, plan=plan, state=known_start())
    lead = found.time_s - NOW_S
    # The scheme is of second order: exact for heat that is linear in time.
    np.testing.assert_allclose(found.mean_K[:, 0], 290.0 + 0.025 * lead**2 / CAPACITY_J_PER_K, rtol=1e-9)


@pytest.mark.parametrize("gap", [np.nan, None])
def test_a_plan_with_nothing_in_it_changes_nothing(gap: float | None) -> None:
    times = NOW_S + np.array([0.0, 500.0])
    plan = record_of(times) if gap is None else record_of(times, Q=gap)
    found = forecast(integrator(), now(10.0), 1000.0, step_s=500.0, plan=plan, state=known_start())
    np.testing.assert_allclose(found.mean_K[:, 0], 290.0 + np.array([1.0, 2.0]))


def test_bands_add_state_noise_and_parameters() -> None:
    """The closed form of an integrator: dT / d ln C = -Q t / C, t from when the filter has last forgotten."""
    model = integrator(std=0.1)
    found = forecast(model, now(20.0), 2000.0, step_s=250.0, state=known_start(std_K=0.5), quantiles=(0.05, 0.5, 0.95))
    lead = found.time_s - NOW_S
    before_K2 = 0.5**2 + (FLOOR_SHARE * NOISE_K) ** 2
    gain = before_K2 / (before_K2 + NOISE_K**2)
    lag_s = 250.0 * (1.0 - gain) / gain
    std = np.sqrt(0.5**2 + NOISE_K**2 + (0.1 * 20.0 * (lag_s + lead) / CAPACITY_J_PER_K) ** 2)
    np.testing.assert_allclose(found.quantiles_K[0.5], found.mean_K)
    np.testing.assert_allclose(found.quantiles_K[0.95][:, 0] - found.mean_K[:, 0], norm.ppf(0.95) * std, rtol=1e-6)
    np.testing.assert_allclose(found.quantiles_K[0.95] + found.quantiles_K[0.05], 2.0 * found.mean_K)


def test_what_the_calibration_could_not_explain_grows_with_lead_time() -> None:
    model = integrator(misfit_K=1.0, misfit_length_s=400.0)
    found = forecast(model, now(), 8000.0, step_s=100.0, state=known_start(), quantiles=(0.9,))
    std = (found.quantiles_K[0.9] - found.mean_K)[:, 0] / norm.ppf(0.9)
    faded = np.exp(-(found.time_s - NOW_S) / 400.0)
    # An integrator keeps for ever what it has taken for a temperature, and the misfit goes on: M(t) - M(0).
    np.testing.assert_allclose(std, np.sqrt(2.0 * (1.0 - faded) + NOISE_K**2), rtol=1e-6)


@pytest.mark.parametrize("length_s", [200.0, 3000.0, 1e6])
def test_the_misfit_is_back_once_the_network_has_forgotten_its_start(length_s: float) -> None:
    """Readings are a trajectory plus a misfit; a state set to them is wrong by it, and relaxes. Ten thousand such futures."""
    wired = {"boundaries": {"room": {"value_K": 290.0}}}
    ends = conductive_spec(2, [(0, 1)], **wired)
    ends["conductors"].append({"between": ["n1", "room"], "conductance_W_per_K": {"guess": 1.0}})
    named = {"C:n0": 5.0e3, "C:n1": 2.0e3, "G:n0|n1": 4.0, "G:n1|room": 3.0}
    misfit_K, step_s, steps = 0.5, 100.0, 80
    model = model_of(load_spec(ends), named, noise_K=1e-3, misfit_K=misfit_K, misfit_length_s=length_s, max_step_s=10.0)
    present = {"time_s": NOW_S, "nodes": ["n0", "n1"], "mean_K": [290.0, 290.0], "covariance_K2": np.zeros(4).tolist()}
    record = record_of(np.array([NOW_S]), T0=290.0, T1=290.0)
    found = forecast(model, record, steps * step_s, step_s=step_s, state=present, quantiles=(0.05, 0.95))

    rate = np.array([[-4.0 / 5.0e3, 4.0 / 5.0e3], [4.0 / 2.0e3, -7.0 / 2.0e3]])
    kept, rng = expm(rate * step_s), np.random.default_rng(4)
    keep = np.exp(-step_s / length_s)
    misfit = misfit_K * rng.standard_normal((10_000, 2))
    wrong, missed = misfit.copy(), []
    for _ in range(steps):
        misfit = keep * misfit + misfit_K * np.sqrt(1.0 - keep**2) * rng.standard_normal(misfit.shape)
        wrong = wrong @ kept.T
        missed.append(misfit - wrong)
    missed_K = np.array(missed).transpose(1, 0, 2)
    low, high = (found.quantiles_K[q] - 290.0 for q in (0.05, 0.95))
    np.testing.assert_allclose(((missed_K > low) & (missed_K < high)).mean(axis=0), 0.9, atol=0.015)
    low, high = (end - 290.0 for end in found.whole_K)
    np.testing.assert_allclose(((missed_K > low) & (missed_K < high)).all(axis=1).mean(axis=0), 0.9, atol=0.04)


LEARNED = {"degree": 0, "vanishing": False, "low_K": (285.0,), "high_K": (291.0,), "misfit_W": 0.0}


@pytest.mark.parametrize("covariance_W2", [(), (16.0,)])
def test_a_learned_heat_says_where_it_was_learned_and_its_band_grows_beyond(covariance_W2: tuple[float, ...]) -> None:
    """An integrator that leaves the range after 500 s: the deviation of the held heat, integrated by hand."""
    heat = LearnedHeatFlow({"node": "n0"}, {"coefficients[0]": 3.0}, LEARNED | {"covariance_W2": covariance_W2})
    model = model_of(
        load_spec(lone_node()), {"C:n0": CAPACITY_J_PER_K}, effects=[heat], noise_K=NOISE_K, max_step_s=10.0
    )
    found = forecast(model, now(7.0), 2000.0, step_s=10.0, state=known_start(), quantiles=(0.95,))
    lead = found.time_s - NOW_S
    np.testing.assert_allclose(found.mean_K[:, 0], 290.0 + 10.0 * lead / CAPACITY_J_PER_K, rtol=1e-9)
    away_K = np.maximum(10.0 * lead / CAPACITY_J_PER_K - 1.0, 0.0)
    unsure_W_per_K = np.sqrt(3.0**2 + sum(covariance_W2)) / 3.0
    lost_K = unsure_W_per_K * away_K**2 / (2.0 * 10.0)
    std = (found.quantiles_K[0.95] - found.mean_K)[:, 0] / norm.ppf(0.95)
    np.testing.assert_allclose(std, np.hypot(NOISE_K, lost_K), rtol=1e-3)
    assert len(found.notices) == 1
    assert "learned_heat_flow(n0): learned at n0 285.00 to 291.00 K; 75% of the prediction" in found.notices[0]


def test_within_its_range_a_learned_heat_says_nothing() -> None:
    heat = LearnedHeatFlow({"node": "n0"}, {"coefficients[0]": 3.0}, LEARNED | {"covariance_W2": ()})
    model = model_of(load_spec(lone_node()), {"C:n0": CAPACITY_J_PER_K}, effects=[heat], noise_K=NOISE_K)
    found = forecast(model, now(7.0), 400.0, step_s=100.0, state=known_start(), quantiles=(0.95,))
    assert found.notices == ()
    np.testing.assert_allclose((found.quantiles_K[0.95] - found.mean_K) / norm.ppf(0.95), NOISE_K)


def test_the_state_is_filtered_from_the_record() -> None:
    """A thousand readings of a resting node: the forecast starts from their mean, not from the last of them."""
    rng = np.random.default_rng(0)
    record = record_of(60.0 * np.arange(1000), T0=290.0 + rng.normal(0.0, NOISE_K, 1000), Q=0.0)
    model = integrator()
    found = forecast(model, record, 600.0)
    assert abs(float(found.mean_K[0, 0]) - 290.0) < 0.05
    assert found.time_s[0] - record.time_s[-1] == 60.0  # the record's own sampling
    late = forecast(
        model, record.take(np.arange(1000) >= 500), 600.0, state=assimilate(model, record.between(0.0, 30001.0)).state
    )
    np.testing.assert_allclose(late.mean_K, found.mean_K, atol=1e-6)


@pytest.mark.parametrize(
    ("horizon_s", "step_s", "quantiles", "message"),
    [
        (0.0, 10.0, (0.5,), "horizon_s: must be a positive number"),
        (-5.0, 10.0, (0.5,), "horizon_s: must be a positive number"),
        (np.nan, 10.0, (0.5,), "horizon_s: must be a positive number"),
        (np.inf, 10.0, (0.5,), "horizon_s: must be a positive number"),
        (100.0, 0.0, (0.5,), "step_s: must be positive and at most the horizon"),
        (100.0, np.nan, (0.5,), "step_s: must be positive and at most the horizon"),
        (100.0, 101.0, (0.5,), "step_s: must be positive and at most the horizon"),
        (1e9, 1.0, (0.5,), "points asked for"),
        (100.0, 10.0, (0.5, 1.0), "quantiles: must lie between 0 and 1"),
        (100.0, 10.0, (0.0,), "quantiles: must lie between 0 and 1"),
        (100.0, 10.0, (np.nan,), "quantiles: must lie between 0 and 1"),
        (100.0, None, (0.5,), "step_s: "),
    ],
)
def test_impossible_requests_are_named(
    horizon_s: float, step_s: float | None, quantiles: Sequence[float], message: str
) -> None:
    with pytest.raises(ArgumentError, match=message) as caught:
        forecast(integrator(), now(), horizon_s, step_s=step_s, quantiles=quantiles, state=known_start())
    again = pickle.loads(pickle.dumps(caught.value))  # as from a worker process
    assert str(again) == str(caught.value) == f"{again.argument}: {again.reason}"


def test_an_input_that_was_never_seen_is_named() -> None:
    record = record_of(np.array([NOW_S]), T0=290.0, Q=np.nan)
    with pytest.raises(TelemetryError, match="channel 'Q' has no samples"):
        forecast(integrator(), record, 100.0, step_s=10.0, state=known_start())


def test_a_plan_beyond_physics_is_a_clear_error() -> None:
    plan = record_of(NOW_S + np.array([0.0, 10.0]), Q=np.array([-1e9, -1e9]))
    with pytest.raises(ModelError, match="no solution over the horizon"):
        forecast(integrator(), now(), 100.0, step_s=10.0, plan=plan, state=known_start())


@pytest.mark.statistical
def test_nine_of_ten_readings_lie_in_the_band() -> None:
    """Healthy spacecraft simulated by SciPy, calibrated on two thirds of the orbits: coverage of the rest, as planned."""
    inside: list[np.ndarray] = []
    for seed in range(3):
        case = network_case(None, seed, n_orbits=4, dt_s=90.0)
        position = np.arange(case.record.time_s.size)
        cut = int(0.67 * position.size)
        past, future = case.record.take(position < cut), case.record.take(position >= cut - 1)
        model = calibrate(case.spec, [past])
        horizon = float(future.time_s[-1] - future.time_s[0])
        found = forecast(model, past, horizon, step_s=90.0, plan=future)
        measured = np.stack([future.values[s] for s in found.sensors], axis=1)[1:]
        low, high = found.quantiles_K[0.05], found.quantiles_K[0.95]
        inside.append(((measured >= low) & (measured <= high)).ravel())
    coverage = float(np.concatenate(inside).mean())
    assert 0.85 < coverage < 0.95, coverage


def test_a_horizon_of_too_many_steps_is_told_by_its_name() -> None:
    """With steps of 10 ms, twenty million of them reach 200,000 s."""
    quick = replace(integrator(), max_step_s=0.01)
    with pytest.raises(
        ModelError, match=r"horizon_s: 1e\+06 s are 1e\+08 steps of at most 0.01 s.*ask for 2e\+05 s or less"
    ):
        forecast(quick, now(), 1e6, step_s=10.0, state=known_start())
