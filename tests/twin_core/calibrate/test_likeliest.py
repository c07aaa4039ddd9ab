"""Trajectories at their greatest likelihood, against a dense Gaussian process about the closed form of one node."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from tests.helpers import record_of
from twin_core._typing import FloatArray
from twin_core.calibrate import likeliest
from twin_core.calibrate.likeliest import greatest_log_posterior
from twin_core.calibrate.residual_noise import fit_whitener
from twin_core.calibrate.second_order import Calibration, fit_network
from twin_core.network.spec_io import load_spec

N, STEP_S, ROOM_K, NOISE_K = 160, 60.0, 290.0, 0.05
C_J_PER_K, G_W_PER_K, POWER_W = 900.0, 0.6, 6.0
SPEC = {
    "twin": "block",
    "channels": {
        "T": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K},
        "Q": {"kind": "power", "unit": "W"},
    },
    "nodes": [{"id": "block", "sensor": "T", "capacity_J_per_K": {"guess": 1000.0}}],
    "boundaries": {"room": {"value_K": ROOM_K}},
    "conductors": [{"between": ["block", "room"], "conductance_W_per_K": {"guess": 0.5}}],
    "loads": [{"channel": "Q", "node": "block"}],
}


def power_W() -> FloatArray:
    return POWER_W * (np.arange(N) // 40 % 2)


def temperature_K(capacity: float, conductance: float, start_K: float) -> FloatArray:
    """Return the closed form under a power that is held between samples."""
    decay, found = np.exp(-STEP_S * conductance / capacity), [start_K - ROOM_K]
    for power in power_W()[:-1]:
        found.append(decay * found[-1] + (1.0 - decay) * power / conductance)
    return ROOM_K + np.array(found)


def calibrated(drift_K: float) -> Calibration:
    """Return the block calibrated by least squares to readings with a misfit that lasts."""
    misfit = drift_K * np.sin(2.0 * np.arange(N) / N) + np.random.default_rng(4).normal(0.0, NOISE_K, N)
    read = temperature_K(C_J_PER_K, G_W_PER_K, 293.0) + misfit
    return fit_network(load_spec(SPEC), [record_of(STEP_S * np.arange(N), Q=power_W(), T=read)])[1]


def dense(calibration: Calibration) -> float:
    """Return the greatest log posterior over parameters and noise together, by a simplex search of dense likelihoods."""
    problem, time_s = calibration.problem, STEP_S * np.arange(N)
    mean, std = problem.prior()
    measured = problem.segments[0].measured_K[:, 0]
    apart = np.abs(time_s[:, None] - time_s)

    def loss(x: FloatArray) -> float:
        unknowns, (colour, length, white) = x[:-3] * std + mean, np.exp(x[-3:])
        by_name = problem.network.parameters.at_free(unknowns[: problem.n_free]).as_dict()
        capacity, conductance = (next(v for k, v in by_name.items() if k.startswith(kind)) for kind in ("C:", "G:"))
        covariance = colour**2 * np.exp(-apart / length) + max(white, 0.7 * NOISE_K) ** 2 * np.eye(N)
        left = measured - temperature_K(capacity, conductance, float(unknowns[-1]))
        return 0.5 * float((x[:-3] ** 2).sum()) - float(multivariate_normal.logpdf(left, cov=covariance))

    start = np.concatenate([(calibration.optimum.unknowns - mean) / std, np.log([0.3, 2400.0, NOISE_K])])
    found = minimize(
        loss, start, method="Nelder-Mead", options={"maxiter": 6000, "maxfev": 6000, "xatol": 1e-4, "fatol": 1e-4}
    )
    return -float(found.fun) - 0.5 * (problem.n_unknowns - problem.n_free) * float(np.log(problem.n_samples))


def at_least_squares(calibration: Calibration) -> float:
    """Return the log posterior where least squares have ended."""
    problem, optimum = calibration.problem, calibration.optimum
    mean, std = problem.prior()
    against = 0.5 * float((((optimum.unknowns - mean) / std) ** 2).sum() + np.log(problem.n_samples))
    return fit_whitener(problem, problem.residuals(optimum.fit)).log_likelihood - against


def test_it_is_the_greatest_over_parameters_and_noise_together() -> None:
    calibration = calibrated(1.5)
    found, plain = calibration.log_posterior, at_least_squares(calibration)
    assert found > plain + 5.0
    assert found == pytest.approx(dense(calibration), abs=1.0)


def test_least_squares_are_likeliest_where_nothing_wanders() -> None:
    calibration = calibrated(0.0)
    assert calibration.log_posterior == pytest.approx(at_least_squares(calibration), abs=likeliest.SETTLED_NATS)


def test_columns_of_no_weight_change_nothing() -> None:
    """Their amounts are averaged over, and their prior allows none."""
    calibration = calibrated(1.5)
    columns = [np.sin(np.arange(N))[:, None]]
    with_some = greatest_log_posterior(
        calibration.problem, calibration.optimum, calibration.whitener, lambda u, f: columns, np.zeros(1), spread=1e-9
    )
    assert with_some == pytest.approx(calibration.log_posterior, abs=1e-3)


def test_a_column_that_the_readings_hold_is_found() -> None:
    """The oracle adds it to the covariance of the noise."""
    calibration = calibrated(0.0)
    problem, column = calibration.problem, np.cos(1.3 * np.arange(N))
    segment = problem.segments[0]
    told = replace(problem, segments=(replace(segment, measured_K=segment.measured_K + 0.5 * column[:, None]),))
    noise = fit_whitener(told, told.residuals(calibration.optimum.fit))
    found = greatest_log_posterior(told, calibration.optimum, noise, lambda u, f: [column[:, None]], np.zeros(1))
    without = calibration.log_posterior
    paid = 0.5 * np.log(1.0 + column @ column / NOISE_K**2) + 0.5 * 0.5**2
    assert found == pytest.approx(without - paid, abs=2.0)


@pytest.mark.parametrize("broken", ["sensor_jacobians", "solved"])
def test_what_was_reached_counts_where_arithmetic_fails(broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    calibration = calibrated(1.5)

    def fails(*_: object) -> None:
        raise ArithmeticError("the readings do not tell the unknowns apart")

    monkeypatch.setattr(likeliest, broken, fails)
    assert calibration.log_posterior == pytest.approx(at_least_squares(calibration), abs=1e-9)
