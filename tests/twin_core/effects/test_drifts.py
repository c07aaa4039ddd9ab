"""Steady changes: inputs and sensors that drift, conductors that depend on their temperature."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.helpers import at_named, conductive_spec, model_of, record_of
from twin_core.assimilate import assimilate
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.undeclared.fit import fit_with_undeclared_heat
from twin_core.calibrate.undeclared.model import UndeclaredHeat, linearise, smoothed_states
from twin_core.effects import REGISTRY, Effect
from twin_core.forecast import forecast
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.network.terms import Along
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

POWER = {"kind": "power", "unit": "W"}
BEGIN_S = 500.0


def input_drift(rate: float) -> Effect:
    return REGISTRY["input_drift"]({"channel": "Q"}, {"r_per_s": rate}, {"t0_s": BEGIN_S, "dated": False})


@pytest.mark.parametrize("rate", [2.0e-4, -2.0e-4], ids=["grows", "dies"])
def test_a_drifting_heater_heats_as_its_integral_and_never_cools(rate: float) -> None:
    data = conductive_spec(1, [], channels={"Q": POWER}, loads=[{"channel": "Q", "node": "n0", "gain": {"value": 0.5}}])
    network = at_named(build_network(load_spec(data), [input_drift(rate)]), {"C:n0": 5.0e3})
    time_s = BEGIN_S + np.arange(0.0, 9000.0, 60.0)
    forcing = build_forcing(network, record_of(time_s, Q=80.0), 5.0)
    path = rollout(network, network.parameters.values, np.array([290.0]), forcing)
    elapsed = time_s - BEGIN_S
    shining = np.minimum(elapsed, np.inf if rate > 0 else -1.0 / rate)
    expected = 290.0 + 40.0 * (shining + 0.5 * rate * shining**2) / 5.0e3
    np.testing.assert_allclose(path.at_samples(forcing.sample_step)[:, 0], expected, atol=1e-3)


def warm(beta: float, nodes: list[str], reference_K: float = 300.0) -> Effect:
    return REGISTRY["conductance_temperature"]({"nodes": nodes}, {"beta_per_K": beta}, {"T_ref_K": reference_K})


def two_nodes() -> dict:
    data = conductive_spec(2, [(0, 1)], channels={"Q": POWER}, loads=[{"channel": "Q", "node": "n0"}])
    data["boundaries"] = {"room": {"value_K": 280.0}}
    data["conductors"] += [{"between": ["n1", "room"], "conductance_W_per_K": {"guess": 1.0}}]
    return data


def conducting(*effects: Effect) -> Network:
    named = {"C:n0": 4.0e3, "C:n1": 9.0e3, "G:n0|n1": 2.0, "G:n1|room": 1.5}
    return at_named(build_network(load_spec(two_nodes()), effects), named)


@pytest.mark.parametrize("beta", [0.02, -0.03])
def test_conductors_that_depend_on_their_temperature_are_what_scipy_integrates(beta: float) -> None:
    network = conducting(warm(beta, ["n1", "n0"]), warm(-beta, ["n1", "room"], 285.0))
    time_s = np.arange(0.0, 8000.0, 100.0)
    forcing = build_forcing(network, record_of(time_s, Q=90.0), 10.0)
    path = rollout(network, network.parameters.values, np.array([305.0, 285.0]), forcing)

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        strap = 2.0 * max(1.0 + beta * (x.mean() - 300.0), 0.0) * (x[1] - x[0])
        leak = 1.5 * max(1.0 - beta * (0.5 * (x[1] + 280.0) - 285.0), 0.0) * (280.0 - x[1])
        return np.array([(90.0 + strap) / 4.0e3, (leak - strap) / 9.0e3])

    exact = solve_ivp(rate, (0.0, time_s[-1]), [305.0, 285.0], t_eval=time_s, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(path.at_samples(forcing.sample_step), exact.y.T, atol=2e-3)


@pytest.mark.parametrize("temperature_K", [1.0, 250.0, 5000.0])
@pytest.mark.parametrize("beta", [0.05, -0.05])
def test_no_conductance_turns_negative(temperature_K: float, beta: float) -> None:
    """Heat never flows from cold to warm, however far from the temperatures that calibrated it."""
    network = conducting(warm(beta, ["n0", "n1"]))
    along = Along(
        np.zeros(1),
        np.array([[temperature_K, temperature_K + 2.0]]),
        np.array([[280.0]]),
        {"Q": np.zeros(1)},
        np.ones(1),
    )
    values, heat = network.parameters.values, 0.0
    for term in network.terms:
        part = term.evaluate(along, values[network.term_index(term)])
        if set(part.nodes) == {0, 1}:
            heat += float(part.heat_W[0, list(part.nodes).index(0)])
    assert heat >= 0.0


def sensor_drift(rate: float) -> Effect:
    return REGISTRY["sensor_drift"]({"sensor": "T0"}, {"d_K_per_s": rate}, {"t0_s": BEGIN_S, "dated": False})


RATE = 4.0e-4


def lone_record(n_times: int, drift: float) -> Record:
    rng = np.random.default_rng(0)
    time_s = BEGIN_S + 60.0 * np.arange(n_times)
    power = rng.choice([0.0, 60.0], n_times)
    truth = 290.0 + np.concatenate([[0.0], np.cumsum(60.0 * power[:-1])]) / 5.0e3
    read = truth + drift * (time_s - BEGIN_S) + rng.normal(0.0, 0.05, n_times)
    return record_of(time_s, Q=power, T0=read)


SPEC = load_spec(conductive_spec(1, [], channels={"Q": POWER}, loads=[{"channel": "Q", "node": "n0"}]))


def test_the_filter_sees_the_node_and_the_forecast_the_sensor() -> None:
    plain = model_of(SPEC, {"C:n0": 5.0e3}, noise_K=0.05)
    faulty = model_of(SPEC, {"C:n0": 5.0e3}, noise_K=0.05, effects=[sensor_drift(RATE)])
    right, wrong = lone_record(60, 0.0), lone_record(60, RATE)
    state, same = assimilate(faulty, wrong), assimilate(plain, right)
    np.testing.assert_allclose(state.mean_K, same.mean_K, atol=1e-9)
    np.testing.assert_allclose(state.innovation_K, same.innovation_K, atol=1e-9)
    ahead, without = forecast(faulty, wrong, 1200.0), forecast(plain, right, 1200.0)
    expected = without.mean_K + RATE * (ahead.time_s - BEGIN_S)[:, None]
    np.testing.assert_allclose(ahead.mean_K, expected, atol=1e-9)


def problem_of(drift: float, *effects: Effect) -> Problem:
    network = at_named(build_network(SPEC, effects), {"C:n0": 5.0e3})
    return build_problem(network, [lone_record(80, drift)], np.array([0.05]), 1e9)


def test_smoothed_temperatures_are_free_of_the_fitted_fault() -> None:
    """The fault's fitted size counts, not the one that the fit began with."""
    latent, found = UndeclaredHeat(np.array([5.0]), 600.0), []
    for problem, named in (
        (problem_of(0.0), {}),
        (problem_of(RATE, sensor_drift(0.0)), {"sensor_drift(T0).d_K_per_s": RATE}),
    ):
        (segment,) = problem.segments
        values = problem.network.parameters.updated(named).values
        states = np.full((segment.forcing.n_steps + 1, 1), 290.0)
        nominal = linearise(problem, values, segment, states, np.zeros((segment.forcing.n_steps, 1)))
        found.append(smoothed_states(problem, values, latent, nominal)[0])
    np.testing.assert_allclose(found[1], found[0], atol=0.05)  # the priors of the first temperature differ by noise


def test_a_fit_finds_the_drift() -> None:
    fit = fit_with_undeclared_heat(problem_of(RATE, sensor_drift(0.0)))
    assert fit.network.parameters.as_dict()["sensor_drift(T0).d_K_per_s"] == pytest.approx(RATE, rel=0.1)
