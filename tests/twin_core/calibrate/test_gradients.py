"""Gradients within nodes: sensors off the mean of their node, against dense marginal likelihoods and a body that has them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim
from scipy.stats import multivariate_normal

from tests.helpers import record_of
from tests.twin_core.calibrate.body_with_gradients import (
    G_W_PER_K,
    LEAK_W_PER_K,
    NOISE_K,
    ROOM_K,
    dense_covariance,
    record,
    spec,
)
from twin_core.calibrate.gradients import BIOT, conductances_W_per_K, heat_flows_K, with_gradients
from twin_core.calibrate.second_order import Calibration, fit_network
from twin_core.effects import REGISTRY
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec


def fitted(share: float) -> Calibration:
    return fit_network(load_spec(spec()), [record(share)])[1]


def test_a_body_with_gradients_is_fitted_to_the_noise() -> None:
    """Along one temperature per node no parameters follow it; the readings say so by hundreds of nats."""
    calibration = fitted(1.0)
    plain = np.concatenate(calibration.residuals).std(axis=0)
    found = with_gradients(calibration.problem, calibration.optimum)
    left = np.concatenate(found.residuals).std(axis=0)
    assert (plain > 1.5 * NOISE_K).all()
    assert left == pytest.approx(NOISE_K, rel=0.1)
    assert found.log_posterior > calibration.log_posterior + 100.0


def test_where_there_are_none_they_cost_more_than_they_gain() -> None:
    calibration = fitted(0.0)
    found = with_gradients(calibration.problem, calibration.optimum)
    assert found.log_posterior < calibration.log_posterior


def test_the_covariance_is_that_under_gradients_of_any_size() -> None:
    calibration = fitted(1.0)
    found = with_gradients(calibration.problem, calibration.optimum)
    oracle = dense_covariance(found)
    scale = np.sqrt(np.diag(oracle))
    assert found.covariance() / scale / scale[:, None] == pytest.approx(oracle / scale / scale[:, None], abs=1e-5)


def test_evidence_is_averaged_over_all_gradients() -> None:
    """The oracle is the dense marginal likelihood of what the mean temperatures leave, gradients in its covariance."""
    calibration = fitted(0.3)
    problem = calibration.problem
    found = with_gradients(problem, calibration.optimum)
    dense = formula = 0.0
    for sensor, flows in enumerate(found.flows_K):
        noise, left = found.whitener.models[sensor], found.residuals[0][:, sensor]
        assert noise.sigma_ou == 0.0
        covariance = noise.sigma_white**2 * np.eye(left.size) + BIOT**2 * flows @ flows.T
        dense += multivariate_normal.logpdf(left + flows @ found.biot[sensor], cov=covariance)
    priors = found.log_posterior - dense
    mean, std = problem.prior()
    formula = -0.5 * (problem.n_unknowns - problem.n_free) * np.log(problem.n_samples)
    least = formula - 0.5 * float((((calibration.optimum.unknowns - mean) / std) ** 2).sum())
    assert priors == pytest.approx(least, abs=1.0)


def test_flows_are_those_of_the_heat_balance() -> None:
    """In a steady state the flows into a node add up to nothing, and each is what its link carries."""
    time_s, power_W = 600.0 * np.arange(100), 30.0
    hot_K = ROOM_K + power_W / LEAK_W_PER_K
    data = spec()
    data["conductors"][0]["conductance_W_per_K"] = {"value": G_W_PER_K}
    data["conductors"][1]["conductance_W_per_K"] = {"value": LEAK_W_PER_K}
    noise = np.random.default_rng(0).normal(0.0, NOISE_K, (100, 2))
    steady = record_of(
        time_s, Q=power_W, T0=hot_K + power_W / G_W_PER_K + noise[:, 0], T1=np.full(100, hot_K) + noise[:, 1]
    )
    calibration = fit_network(load_spec(data), [steady])[1]
    point = calibration.problem, calibration.optimum.unknowns, calibration.optimum.fit
    conductance = conductances_W_per_K(*point)
    assert conductance == pytest.approx([G_W_PER_K, G_W_PER_K + LEAK_W_PER_K])
    first, second = heat_flows_K(*point, conductance)
    assert first[-1] * G_W_PER_K == pytest.approx([-power_W, power_W], rel=1e-3)
    assert second[-1] * (G_W_PER_K + LEAK_W_PER_K) == pytest.approx([power_W, -power_W], rel=1e-3)


def test_a_node_that_gives_its_heat_to_nothing_has_no_gradients() -> None:
    """Without a conductance there is no Biot number."""
    data = {
        "twin": "block",
        "channels": {"T": {"kind": "temperature", "unit": "K"}, "Q": {"kind": "power", "unit": "W"}},
        "nodes": [{"id": "block", "sensor": "T", "capacity_J_per_K": {"guess": 1e3}}],
        "loads": [{"channel": "Q", "node": "block"}],
    }
    rng, time_s = np.random.default_rng(1), 60.0 * np.arange(60)
    power = rng.choice([0.0, 5.0], 60)
    read = 290.0 + np.concatenate([[0.0], np.cumsum(power)[:-1]]) * 60.0 / 2e3 + rng.normal(0.0, NOISE_K, 60)
    calibration = fit_network(load_spec(data), [record_of(time_s, Q=power, T=read)])[1]
    found = with_gradients(calibration.problem, calibration.optimum)
    assert found.biot[0].size == 0
    assert found.log_posterior == pytest.approx(calibration.log_posterior, abs=0.1)


def test_a_sensor_that_lags_reads_its_gradients_late() -> None:
    """Its place on the body has a temperature, behind which it lags. The oracle is SciPy's first-order filter."""
    plain, step_s, tau_s = fitted(1.0), 60.0, 300.0
    values = plain.network.parameters.as_dict()
    network = build_network(load_spec(spec()), [REGISTRY["sensor_lag"]({"sensor": "T0"}, {"tau_s": tau_s})])
    problem = plain.problem.with_network(network.with_parameters(network.parameters.updated(values)))
    without, unknowns = plain.problem, plain.optimum.unknowns
    begun_K = unknowns[without.start_columns(0)]
    start = problem.start()
    start[problem.start_columns(0)] = [*begun_K, begun_K[0]]
    late_point, point = (problem, start, problem.solve(start)), (without, unknowns, plain.optimum.fit)
    with_lag = heat_flows_K(*late_point, conductances_W_per_K(*late_point))
    now = heat_flows_K(*point, conductances_W_per_K(*point))
    states = StateSpace(-1.0 / tau_s, 1.0 / tau_s, 1.0, 0.0)
    time_s = step_s * np.arange(400)
    for late, flow in zip(with_lag[0].T, now[0].T, strict=False):
        assert late == pytest.approx(lsim(states, flow, time_s, X0=flow[0])[1], abs=1e-3)
    assert with_lag[1] == pytest.approx(now[1], abs=1e-9)


def test_flows_are_those_of_the_fit_beside_gradients() -> None:
    """Not those of the fit without them, whose parameters make up for gradients; G is that of the fit without them."""
    calibration = fitted(1.0)
    problem, optimum = calibration.problem, calibration.optimum
    found = with_gradients(problem, optimum)
    conductance = conductances_W_per_K(problem, optimum.unknowns, optimum.fit)
    flows = heat_flows_K(problem, found.optimum.unknowns, found.optimum.fit, conductance)
    before = heat_flows_K(problem, optimum.unknowns, optimum.fit, conductance)
    for mine, own, old in zip(found.flows_K, flows, before, strict=True):
        assert mine == pytest.approx(own, rel=1e-12)
        assert np.abs(own - old).max() > 0.05 * np.abs(own).max()


def test_gradients_that_would_leave_too_much_are_not_fitted() -> None:
    """Noise alone of a body that has them; three times the noise, which is nine of its variances, of one that reads so."""
    calibration = fitted(1.0)
    problem, optimum = calibration.problem, calibration.optimum
    assert with_gradients(problem, optimum, most_left=0.2) is not None
    rng = np.random.default_rng(8)
    strange = [replace(s, measured_K=s.measured_K + rng.normal(0.0, 3.0 * NOISE_K, (400, 2))) for s in problem.segments]
    spoilt = replace(problem, segments=tuple(strange))
    at = replace(optimum, fit=spoilt.solve(optimum.unknowns))
    assert with_gradients(spoilt, at, most_left=8.0) is None
    assert with_gradients(spoilt, at, most_left=10.0) is not None
