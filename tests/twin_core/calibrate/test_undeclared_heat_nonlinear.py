"""The likelihood beside undeclared heat where the heat balance is not linear: against the integral over all heats, drawn."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import logsumexp

from tests.helpers import record_of
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.undeclared.model import Nominal, UndeclaredHeat, linearise, log_likelihood, smoothed_states
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec

CAPACITY_J_PER_K, RADIATION_W_PER_K4 = 2.0e3, 0.9 * 0.5 * 5.670374419e-8
STEP_S, N_STEPS, N_DRAWS = 300.0, 60, 4000
NOISE_K, START_STD_K = 0.1, 5.0
HEAT = UndeclaredHeat(np.array([30.0]), 6000.0)
SUBSTEPS = 4


def temperatures_K(start_K: np.ndarray, heat_W: np.ndarray) -> np.ndarray:
    """Return the temperatures of a radiating node at all instants, (n_steps + 1, n), of n starts and heats (n_steps, n)."""
    states, temperature = [start_K], start_K

    def rate(at_K: np.ndarray, heat: np.ndarray) -> np.ndarray:
        return (heat - RADIATION_W_PER_K4 * at_K**4) / CAPACITY_J_PER_K

    h = STEP_S / SUBSTEPS
    for heat in heat_W:
        for _ in range(SUBSTEPS):
            a = rate(temperature, heat)
            b = rate(temperature + 0.5 * h * a, heat)
            c = rate(temperature + 0.5 * h * b, heat)
            d = rate(temperature + h * c, heat)
            temperature = temperature + h * (a + 2.0 * b + 2.0 * c + d) / 6.0
        states.append(temperature)
    return np.array(states)


def readings(mean_W: float, swing_W: float) -> tuple[np.ndarray, np.ndarray]:
    """Return instants and readings of a node whose heater nobody declared."""
    rng = np.random.default_rng(4)
    time_s = STEP_S * np.arange(N_STEPS + 1)
    heat = mean_W + swing_W * np.sin(2.0 * np.pi * time_s[:-1] / 5400.0) + rng.normal(0.0, 3.0, N_STEPS)
    truth = temperatures_K(np.array([240.0]), heat[:, None])[:, 0]
    return time_s, truth + rng.normal(0.0, NOISE_K, truth.size)


def radiating_node(time_s: np.ndarray, read_K: np.ndarray) -> Problem:
    spec = {
        "twin": "radiating-node",
        "boundaries": {"space": {"value_K": 0.0}},
        "channels": {"T": {"kind": "temperature", "unit": "K"}},
        "nodes": [{"id": "n", "sensor": "T", "capacity_J_per_K": {"value": CAPACITY_J_PER_K}}],
        "radiators": [{"node": "n", "emissivity": 0.9, "area_m2": 0.5, "sink": "space"}],
    }
    return build_problem(build_network(load_spec(spec)), [record_of(time_s, T=read_K)], np.array([NOISE_K]), 1e9)


def drawn_log_likelihood(read_K: np.ndarray, start_K: float) -> tuple[float, float]:
    """Return the log-likelihood by importance sampling about the likeliest heats, and its standard error.

    The unknowns are standard normal: the start, the first heat, and what is new in the heat from step to step.
    """
    keep = np.exp(-STEP_S / HEAT.length_s)

    def predicted(unknowns: np.ndarray) -> np.ndarray:
        heat = np.empty((N_STEPS, unknowns.shape[1]))
        heat[0] = HEAT.std_W[0] * unknowns[1]
        for k in range(1, N_STEPS):
            heat[k] = keep * heat[k - 1] + np.sqrt(1.0 - keep**2) * HEAT.std_W[0] * unknowns[1 + k]
        return temperatures_K(start_K + START_STD_K * unknowns[0], heat)

    def misfit(unknowns: np.ndarray) -> np.ndarray:
        return (predicted(unknowns) - read_K[:, None]) / NOISE_K

    found = least_squares(
        lambda u: np.concatenate([misfit(u[:, None])[:, 0], u]), np.zeros(N_STEPS + 1), method="lm", xtol=1e-10
    )
    root = np.linalg.cholesky(np.linalg.inv(found.jac.T @ found.jac))
    standard = np.random.default_rng(7).normal(size=(N_STEPS + 1, N_DRAWS))
    unknowns = found.x[:, None] + root @ standard
    log_joint = -0.5 * (misfit(unknowns) ** 2).sum(axis=0) - 0.5 * (unknowns**2).sum(axis=0)
    log_weight = log_joint + 0.5 * (standard**2).sum(axis=0) + np.log(np.diag(root)).sum()
    weight = np.exp(log_weight - log_weight.max())
    constant = -read_K.size * np.log(NOISE_K * np.sqrt(2.0 * np.pi))
    return float(logsumexp(log_weight) - np.log(N_DRAWS) + constant), float(weight.std() / weight.mean() / N_DRAWS**0.5)


def about_smoothed_temperatures(problem: Problem) -> Nominal:
    """Return the problem linearised about what it makes of the readings, starting from the readings themselves."""
    (segment,) = problem.segments
    values = problem.network.parameters.values
    nominal = linearise(problem, values, segment, segment.measured_K, np.zeros((N_STEPS, 1)))
    for _ in range(10):
        states_K, heat_W, _ = smoothed_states(problem, values, HEAT, nominal)
        nominal = linearise(problem, values, segment, states_K, heat_W[:-1])
    return nominal


@pytest.mark.parametrize(("mean_W", "swing_W", "away_K"), [(0.0, 20.0, 0.0), (80.0, 70.0, 50.0), (150.0, 100.0, 100.0)])
def test_the_likelihood_is_the_integral_over_all_heats_however_far_the_declared_model_lies_from_the_readings(
    mean_W: float, swing_W: float, away_K: float
) -> None:
    time_s, read_K = readings(mean_W, swing_W)
    problem = radiating_node(time_s, read_K)
    (segment,) = problem.segments
    nominal = about_smoothed_temperatures(problem)
    assert segment.start_std_K[0] == START_STD_K
    assert np.abs(nominal.residual_K).max() > away_K  # of the model without heat
    drawn, error = drawn_log_likelihood(read_K, float(segment.start_prior_K[0]))
    assert error < 0.05
    assert log_likelihood(problem, HEAT, [nominal]) == pytest.approx(drawn, abs=0.6)
