"""The covariance of a fit to trajectories: the textbook's matrices written out, and bands that hold what they should."""

import numpy as np
import pytest

from tests.helpers import at_named, record_of
from tests.twin_core.calibrate.test_calibrate import STEP_S, TRUTH, declared, exact_K, heat_W, scores
from tests.twin_core.calibrate.test_outliers import spoilt
from tests.twin_core.calibrate.test_restricted import dense, noise
from twin_core.calibrate import calibrate, covariance, restricted
from twin_core.calibrate.covariance import gls_covariance, trajectory_covariance
from twin_core.calibrate.optimise import minimise
from twin_core.calibrate.residual_noise import fit_whitener, sensor_jacobians
from twin_core.calibrate.restricted import ExpectedNoise
from twin_core.calibrate.second_order import Calibration, fit_trajectories, prepare
from twin_core.calibrate.summary import to_model
from twin_core.effects.proportional_heater import ProportionalHeater
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate import response
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record


def telemetry(seed: int, misfit_K: float = 0.0, length_s: float = 1e4, n_times: int = 300) -> Record:
    """Return readings of the pair of nodes, whose sensors err by a slow misfit besides their white noise."""
    rng = np.random.default_rng(seed)
    time_s, heat = STEP_S * np.arange(n_times), heat_W(n_times, seed)
    root = np.linalg.cholesky(dense(noise(misfit_K, length_s), time_s))
    read = exact_K(heat, time_s) + root @ rng.normal(size=(n_times, 2))
    return record_of(time_s, Q=heat, T_a=read[:, 0], T_b=read[:, 1])


def fitted(record: Record, loss: str = "squared") -> Calibration:
    return fit_trajectories(load_spec(declared()), [record], loss="huber" if loss == "huber" else "squared")


def test_it_is_that_of_least_squares_under_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: H^-1 (J' W S W J + P) H^-1 with every matrix in full, a reading missing here and there."""
    record = telemetry(0, 0.05)
    record.values["T_b"][40:60] = np.nan
    done = fitted(record)
    given = [ExpectedNoise(0.02, ((0.01, 3e3), (0.002, 5e4))), ExpectedNoise(0.03, ())]
    monkeypatch.setattr(covariance, "restricted_noise", lambda *_: given)
    problem = done.problem
    seen = [np.isfinite(record.values[name]) for name in ("T_a", "T_b")]
    jacobian = dict(sensor_jacobians(problem, done.optimum))
    weight, hessian = 1.0 / problem.noise_K**2, np.diag(1.0 / problem.prior()[1] ** 2)
    spread = hessian.copy()
    for sensor, expected in enumerate(given):
        rows, time_s = jacobian[sensor][seen[sensor]], record.time_s[seen[sensor]]
        full = expected.white_K2 * np.eye(time_s.size)
        for variance, length_s in expected.coloured:
            full += dense(noise(np.sqrt(variance), length_s, 0.0), time_s)
        hessian += weight[sensor] * rows.T @ rows
        spread += weight[sensor] ** 2 * rows.T @ full @ rows
    oracle = np.linalg.solve(hessian, np.linalg.solve(hessian, spread).T)
    np.testing.assert_allclose(trajectory_covariance(problem, done.optimum, done.whitener), oracle, rtol=1e-6)


def test_records_may_come_in_stretches_and_sensors_in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """The covariance is the same as if all derivatives were held at once: over two segments, of which one lacks readings and has
    a gap that fills stretches of its own."""
    first, second = telemetry(0, 0.05), telemetry(1, 0.05, n_times=150)
    first.values["T_b"][40:60] = np.nan
    kept = np.r_[0:80, 230 : first.time_s.size]
    first = Record(first.time_s[kept], {name: values[kept] for name, values in first.values.items()})
    done = fit_trajectories(load_spec(declared()), [first, second])
    arguments = (done.problem, done.optimum, done.whitener)
    once = trajectory_covariance(*arguments)
    monkeypatch.setattr(response, "MOST_VALUES", 1)
    monkeypatch.setattr(response, "LEAST_STEPS", 7)
    monkeypatch.setattr(covariance, "MOST_TURNED", 1)
    stretches = [block for _, _, block in done.problem.jacobian_stretches(done.optimum.unknowns, done.optimum.fit)]
    assert any(block.shape[0] == 0 for block in stretches)
    std = np.sqrt(np.diag(once))
    np.testing.assert_allclose((trajectory_covariance(*arguments) - once) / np.outer(std, std), 0.0, atol=1e-9)


def test_averages_over_neighbours_tell_the_noise_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where derivatives are many, rows stand for several readings: the bands hardly move."""
    done = fitted(telemetry(2, 0.05, n_times=600))
    arguments = (done.problem, done.optimum, done.whitener)
    once = np.sqrt(np.diag(trajectory_covariance(*arguments)))
    monkeypatch.setattr(restricted, "MOST_VALUES", 1)
    averaged = np.sqrt(np.diag(trajectory_covariance(*arguments)))
    assert 0.7 < (averaged / once).min() and (averaged / once).max() < 1.4


def test_under_white_noise_no_estimate_is_more_certain() -> None:
    """Weighed as it deserves, white noise leaves the certainty of generalised least squares, and little less."""
    growth = []
    for seed in range(8):
        done = fitted(telemetry(seed))
        arguments = (done.problem, done.optimum, done.whitener)
        growth.append(np.sqrt(np.diag(trajectory_covariance(*arguments)) / np.diag(gls_covariance(*arguments))))
    assert np.min(growth) > 0.98
    assert np.median(growth) < 1.15


@pytest.mark.statistical
def test_the_bands_hold_the_truth_that_a_slow_misfit_has_bent() -> None:
    """Over draws of a misfit half as large as the noise nine of ten bands of 90 % hold the truth; as it looked, fewer."""
    pulls, looked = [], []
    for seed in range(24):
        record = telemetry(seed, 0.05)
        done = fitted(record)
        model = to_model(done, ())
        pulls += list(scores(model, TRUTH).values())
        std = np.sqrt(np.diag(gls_covariance(done.problem, done.optimum, done.whitener)))
        named = dict(zip(model.free_names, std, strict=False))
        looked += [np.log(model.values[name] / value) / named[name] for name, value in TRUTH.items()]
    held, held_before = (float(np.mean(np.abs(z) < 1.645)) for z in (pulls, looked))
    assert 0.82 < held < 0.98
    assert held_before < held - 0.1


def test_readings_that_hubers_loss_holds_back_bend_nothing() -> None:
    """A tenth of wild readings: the band is near that of the healthy record, not that of the wild readings' spread."""
    healthy = telemetry(3, n_times=600)
    rng = np.random.default_rng(3)
    at = rng.choice(600, 60, replace=False)
    wild = spoilt(healthy, at, healthy.values["T_a"][at] + rng.choice([-3.0, 3.0], 60))

    def stds(record: Record, loss: str) -> np.ndarray:
        done = fitted(record, loss)
        free = trajectory_covariance(done.problem, done.optimum, done.whitener)[: done.problem.n_free]
        return np.sqrt(np.diag(free))

    growth = stds(wild, "huber") / stds(healthy, "squared")
    assert 0.9 < growth.min() and growth.max() < 1.6
    assert (stds(wild, "squared") / stds(healthy, "squared")).max() > 3.0


def heated(limit_W: float, seed: int) -> tuple[Record, ProportionalHeater]:
    """Return readings of the pair with a heater of 2 W/K, whose coldest moment asks for some 12 W."""
    heat, time_s = heat_W(300, 0), STEP_S * np.arange(300)
    heater = ProportionalHeater({"node": "b"}, {"k_W_per_K": 2.0, "T_set_K": 290.0, "Q_W": limit_W})
    network = at_named(build_network(load_spec(declared()), [heater]), TRUTH)
    forcing = build_forcing(network, record_of(time_s, Q=heat), STEP_S)
    path = rollout(network, network.parameters.values, np.array([284.0, 284.0]), forcing)
    read = path.at_samples(np.arange(300)) + np.random.default_rng(seed).normal(0.0, 0.1, (300, 2))
    return record_of(time_s, Q=heat, T_a=read[:, 0], T_b=read[:, 1]), heater


@pytest.mark.parametrize(("limit_W", "is_told"), [(20.0, False), (6.0, True)])
def test_a_limit_that_was_hardly_reached_is_open_ended(limit_W: float, is_told: bool) -> None:
    """The fit ends where its limit cuts off a peak or two, by chance of the noise: it may be any above."""
    record, heater = heated(limit_W, 1)
    start = heater.with_values({"Q_W": min(limit_W, 10.8)})
    problem, step_s = prepare(load_spec(declared()), [record], [start])
    problem = problem.with_network(at_named(problem.network, TRUTH))
    optimum = minimise(problem, problem.start())
    done = Calibration(problem, optimum, fit_whitener(problem, problem.residuals(optimum.fit)), step_s)
    row = next(p for p in to_model(done, [start]).summary["parameters"] if p["name"].endswith("Q_W"))
    assert row["identified"] == is_told
    assert (row["std"] < 0.1 * row["mean"]) == is_told
    assert abs(row["mean"] - limit_W) < 1.645 * row["std"]


def test_what_only_the_guesses_tell_keeps_their_uncertainty() -> None:
    """Capacity, conductance and gain may grow by one factor unseen: along it the variance is that of the guesses, 1."""
    data = declared()
    data["loads"] = [{"channel": "Q", "node": "a", "gain": {"guess": 1.2}}]
    model = calibrate(load_spec(data), [telemetry(0, 0.05)])
    together = np.array([name[:2] in ("C:", "G:", "ga") for name in model.free_names]) / np.sqrt(len(model.free_names))
    smallest = np.linalg.eigvalsh(model.covariance)[0]
    np.testing.assert_allclose(model.covariance, model.covariance.T, rtol=1e-9, atol=1e-12)
    assert smallest > 0.0
    assert together @ model.covariance @ together == pytest.approx(1.0, rel=0.02)


def test_long_records_are_averaged_within_their_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two segments of 300 readings, one of them with a hole: six together, and none across the gap between them."""
    records = [telemetry(0, 0.05), telemetry(1, 0.05)]
    records[1].values["T_b"][100:150] = np.nan
    done = fit_trajectories(load_spec(declared()), records)
    whole = trajectory_covariance(done.problem, done.optimum, done.whitener)
    monkeypatch.setattr(restricted, "MOST_ROWS", 100)
    residuals = done.problem.residuals(done.optimum.fit)
    left = restricted._leftovers(done.problem, done.optimum, done.whitener, residuals)
    for sensor, together, expected in ((0, 6, [50, 50]), (1, 6, [50, 41])):
        assert left[sensor].together == together
        parts = [r[:, sensor][np.isfinite(r[:, sensor])] for r in residuals]
        means = [p[: n * together].reshape(n, together).mean(axis=1) for p, n in zip(parts, expected, strict=True)]
        np.testing.assert_allclose(left[sensor].columns[:, -1], np.concatenate(means), atol=1e-12)
    averaged = trajectory_covariance(done.problem, done.optimum, done.whitener)
    np.testing.assert_allclose(np.sqrt(np.diag(averaged)), np.sqrt(np.diag(whole)), rtol=0.3)
