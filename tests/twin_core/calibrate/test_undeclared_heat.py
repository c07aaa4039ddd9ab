"""Fitting in the presence of undeclared heat: the likelihood densely, its slopes numerically, and what it recovers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize as minimise_by_simplex
from scipy.stats import multivariate_normal

from tests.analytic import laplacian, linear_states
from tests.helpers import at_named, central_difference, conductive_spec, record_of
from twin_core.calibrate.optimise import minimise
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.undeclared.fit import fit_with_undeclared_heat, gauss_newton, steps_to_try
from twin_core.calibrate.undeclared.model import (
    Nominal,
    UndeclaredHeat,
    linearise,
    log_likelihood,
    parameter_columns,
    smoothed_states,
)
from twin_core.calibrate.undeclared.size import SizeSearch
from twin_core.discover.shortlist import survey_of
from twin_core.discover.trial import extended
from twin_core.effects.capacity_temperature import CapacityTemperature
from twin_core.effects.constant_heat_load import ConstantHeatLoad
from twin_core.latent_force.held import grid_of
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

CAPACITY = np.array([4.0e3, 9.0e3])
CONDUCTANCE = 3.0
NOISE_K = np.array([0.1, 0.2])
LATENT = UndeclaredHeat(np.array([5.0, 12.0]), 400.0)
STEP_S = 60.0
RATES = -laplacian(2, [(0, 1)], [CONDUCTANCE]) / CAPACITY[:, None]


def spec_data() -> dict:
    power = {"kind": "power", "unit": "W"}
    return conductive_spec(2, [(0, 1)], channels={"Q": power}, loads=[{"channel": "Q", "node": "n0"}])


def record(n_times: int, seed: int = 0) -> Record:
    rng = np.random.default_rng(seed)
    power = np.repeat(rng.choice([0.0, 40.0, 90.0], n_times // 8 + 1), 8)[:n_times]
    time_s = STEP_S * np.arange(n_times)
    truth = linear_states(RATES, np.outer(power, [1.0 / CAPACITY[0], 0.0]), np.array([290.0, 285.0]), time_s)
    read = truth + rng.normal(size=truth.shape) * NOISE_K
    read[rng.random(truth.shape) < 0.15] = np.nan
    return record_of(time_s, Q=power, T0=read[:, 0], T1=read[:, 1])


def small_problem(n_times: int = 25) -> Problem:
    named = {"C:n0": CAPACITY[0], "C:n1": CAPACITY[1], "G:n0|n1": CONDUCTANCE}
    network = at_named(build_network(load_spec(spec_data())), {k: float(v) for k, v in named.items()})
    return build_problem(network, [record(n_times)], NOISE_K, 1e9)


def about_own_rollout(problem: Problem) -> Nominal:
    """Return the problem linearised about its own trajectory, without undeclared heat."""
    (segment,) = problem.segments
    values = problem.network.parameters.values
    path = rollout(problem.network, values, segment.start_prior_K, segment.forcing)
    states = np.vstack([path.start_K, path.stages_K[:, 1]])
    return linearise(problem, values, segment, states, np.zeros((segment.forcing.n_steps, 2)))


def scheme(drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (A, b) of one step with held drive, by one exponential."""
    z = np.zeros((3, 3))
    z[:2, :2], z[:2, 2] = RATES * STEP_S, drive * STEP_S
    joint = expm(z)
    return joint[:2, :2], joint[:2, 2]


def dense_joint(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of all readings of [T, q] models, written as sums over independent sources."""
    (segment,) = problem.segments
    power = segment.record.values["Q"]
    n_times = power.size
    transition, _ = scheme(np.zeros(2))
    response = np.stack([scheme(np.eye(2)[i] / CAPACITY[i])[1] for i in range(2)], axis=1)
    keep = np.exp(-STEP_S / LATENT.length_s)
    full = np.block([[transition, response], [np.zeros((2, 2)), keep * np.eye(2)]])
    floor = (1e-3 * np.median(NOISE_K)) ** 2  # what keeps the filter awake, per step
    increment = np.concatenate([np.full(2, floor), (1.0 - keep**2) * LATENT.std_W**2])
    mean, means = segment.start_prior_K, [segment.start_prior_K]
    states = [np.hstack([np.eye(4), np.zeros((4, 4 * (n_times - 1)))])]
    scales = [np.concatenate([segment.start_std_K**2, LATENT.std_W**2])]
    for k in range(1, n_times):
        mean = transition @ mean + scheme(np.array([power[k - 1] / CAPACITY[0], 0.0]))[1]
        means.append(mean)
        state = full @ states[-1]
        state[:, 4 * k : 4 * k + 4] = np.eye(4)
        states.append(state)
        scales.append(increment)
    design = np.concatenate([s[:2] for s in states])
    covariance = design @ np.diag(np.concatenate(scales)) @ design.T + np.diag(np.tile(NOISE_K**2, n_times))
    return np.concatenate(means), covariance


def test_the_likelihood_is_the_joint_gaussian() -> None:
    problem = small_problem()
    mean, covariance = dense_joint(problem)
    seen = problem.segments[0].valid.ravel()
    read = problem.segments[0].measured_K.ravel()
    expected = multivariate_normal.logpdf(read[seen], mean[seen], covariance[np.ix_(seen, seen)])
    found = log_likelihood(problem, LATENT, [about_own_rollout(problem)])
    assert found == pytest.approx(expected, abs=1e-6)


def test_parameter_columns_are_the_central_difference_of_the_trajectory() -> None:
    problem = small_problem()
    (segment,) = problem.segments
    parameters = problem.network.parameters
    found = parameter_columns(problem, parameters.values, about_own_rollout(problem))
    for column in range(parameters.free.size):

        def read(x: float, column: int = column) -> np.ndarray:
            free = parameters.free.copy()
            free[column] = x
            path = rollout(problem.network, parameters.to_values(free), segment.start_prior_K, segment.forcing)
            return path.at_samples(segment.forcing.sample_step)

        expected = central_difference(read, float(parameters.free[column]), 1e-3)
        np.testing.assert_allclose(found[:, :, column], expected, atol=1e-6)


def test_the_hessian_is_that_of_generalised_least_squares() -> None:
    """J' S^-1 J plus the prior, with S the dense covariance and J the central difference."""
    problem = small_problem()
    nominal = about_own_rollout(problem)
    parameters = problem.network.parameters
    _, covariance = dense_joint(problem)
    seen = problem.segments[0].valid.ravel()
    columns = parameter_columns(problem, parameters.values, nominal).reshape(seen.size, -1)[seen]
    inverse = np.linalg.inv(covariance[np.ix_(seen, seen)])
    expected = columns.T @ inverse @ columns + np.diag(1.0 / parameters.prior_std**2)
    hessian, gradient = gauss_newton(problem, parameters.free, LATENT, [nominal])
    np.testing.assert_allclose(hessian, expected, rtol=1e-7)
    residual = (problem.segments[0].measured_K - nominal.reference_K).ravel()[seen]
    np.testing.assert_allclose(gradient, -columns.T @ inverse @ residual, rtol=1e-6, atol=1e-9)


def test_where_a_whole_step_goes_too_far_a_load_moves_to_its_likeliest_size_beside_all_else() -> None:
    problem = small_problem()
    loaded = extended(problem, [ConstantHeatLoad({"node": "n1"}, {"Q_W": 0.0})])
    nominal, values = about_own_rollout(loaded), loaded.network.parameters.values
    seen = loaded.segments[0].valid.ravel()
    _, covariance = dense_joint(problem)
    response = parameter_columns(loaded, values, nominal).reshape(seen.size, -1)[seen][:, -1]
    weighed = np.linalg.solve(covariance[np.ix_(seen, seen)], response)
    residual = (loaded.segments[0].measured_K - nominal.reference_K).ravel()[seen]
    free = loaded.network.parameters.free
    whole, rest, *_ = steps_to_try(loaded, free, *gauss_newton(loaded, free, LATENT, [nominal]))
    assert np.abs(whole[:-1]).min() > 0.0
    np.testing.assert_allclose(rest, [0.0, 0.0, 0.0, weighed @ residual / (weighed @ response)], rtol=1e-5)


def three_nodes(seed: int, missing_W: float) -> tuple[Problem, dict[str, float]]:
    """Return a problem whose telemetry holds heat that nobody declared on the middle node, and the truth."""
    rng = np.random.default_rng(seed)
    capacity, conductance = np.array([4.0e3, 7.0e3, 2.5e3]), [2.0, 1.2]
    edges = [(0, 1), (1, 2)]
    power = {name: {"kind": "power", "unit": "W"} for name in ("Q0", "Q2")}
    loads = [{"channel": "Q0", "node": "n0"}, {"channel": "Q2", "node": "n2"}]
    walls = [{"between": [f"n{i}", "room"], "conductance_W_per_K": {"value": 0.8}} for i in range(3)]
    data = conductive_spec(3, edges, channels=power, loads=loads, boundaries={"room": {"value_K": 285.0}})
    data["conductors"] += walls
    time_s = 60.0 * np.arange(500)
    heat = {c: np.repeat(rng.choice([0.0, 30.0, 60.0], 40), 13)[:500] for c in power}
    hidden = missing_W * (1.0 + np.sin(2.0 * np.pi * time_s / 5400.0))
    rates = -(laplacian(3, edges, conductance) + 0.8 * np.eye(3)) / capacity[:, None]
    drive = (np.stack([heat["Q0"], hidden, heat["Q2"]], axis=1) + 0.8 * 285.0) / capacity
    states = linear_states(rates, drive, np.full(3, 288.0), time_s) + rng.normal(0.0, 0.05, (500, 3))
    readings = {f"T{i}": states[:, i] for i in range(3)}
    spec = load_spec(data)
    problem = build_problem(build_network(spec), [record_of(time_s, **heat, **readings)], np.full(3, 0.05), 1e9)
    truth = {f"C:n{i}": float(c) for i, c in enumerate(capacity)}
    return problem, truth | {"G:n0|n1": conductance[0], "G:n1|n2": conductance[1]}


def log_errors(problem: Problem, values: np.ndarray, truth: dict[str, float]) -> np.ndarray:
    named = dict(zip(problem.network.parameters.index, values, strict=True))
    return np.array([np.log(named[name] / value) for name, value in truth.items()])


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_parameters_are_recovered_although_heat_is_missing(seed: int) -> None:
    """Plain trajectories bend the parameters to swallow 20 W; the undeclared heat takes it instead."""
    problem, truth = three_nodes(seed, 20.0)
    fit = fit_with_undeclared_heat(problem)
    plain = minimise(problem)
    with_heat = np.abs(log_errors(problem, fit.values, truth))
    without = np.abs(log_errors(problem, problem.values(plain.unknowns), truth))
    told = np.array([name != "C:n1" for name in truth])  # the heat's own node: only its response to others tells
    assert with_heat[told].max() < 0.02
    assert with_heat.max() < 0.7
    assert without[told].max() > 10.0 * with_heat[told].max()
    assert np.argmax(fit.undeclared.std_W) == 1  # the heat is on the middle node
    assert 5.0 < fit.undeclared.std_W[1] < 60.0


def test_no_start_near_the_truth_does_better() -> None:
    """A size of the heat held in watts would trap the capacities far from their optimum."""
    problem, truth = three_nodes(2, 20.0)
    from_guesses = fit_with_undeclared_heat(problem)
    from_truth = fit_with_undeclared_heat(problem, problem.network.parameters.updated(truth).free)
    assert from_guesses.log_posterior > from_truth.log_posterior - 1.0


def test_nothing_is_made_up_where_nothing_is_missing() -> None:
    problem, truth = three_nodes(1, 0.0)
    fit = fit_with_undeclared_heat(problem)
    assert np.abs(log_errors(problem, fit.values, truth)).max() < 0.05
    assert fit.undeclared.std_W.max() < 1.0


def test_no_other_size_of_the_heat_is_much_likelier() -> None:
    """The quasi-Newton passes end where a simplex search, which knows no slope, finds nothing more."""
    problem, _ = three_nodes(2, 20.0)
    fit = fit_with_undeclared_heat(problem)

    def cost(log_sizes: np.ndarray) -> float:
        size = UndeclaredHeat(fit.undeclared.std_W * np.exp(log_sizes[:3]), fit.undeclared.length_s)
        return -log_likelihood(problem, size, fit.nominals)

    best = minimise_by_simplex(cost, np.zeros(3), method="Nelder-Mead", options={"maxiter": 300}).fun
    assert -best < fit.log_likelihood + 0.2


def test_a_fit_never_ends_below_where_it_started() -> None:
    problem, _ = three_nodes(2, 20.0)
    short = fit_with_undeclared_heat(problem, n_passes=1)
    long = fit_with_undeclared_heat(problem, near=short, free=short.free, n_passes=6)
    assert long.log_posterior >= short.log_posterior - 1e-6


def test_a_fit_to_other_readings_takes_over_none_of_their_pattern() -> None:
    """Which intervals are alike depends on which readings there are: a fit close by may know others."""
    problem, _ = three_nodes(2, 20.0)
    near = fit_with_undeclared_heat(problem, n_passes=1)
    (segment,) = problem.segments
    measured = segment.measured_K.copy()
    measured[10:60:3, 0] = np.nan
    fewer = replace(problem, segments=(replace(segment, measured_K=measured),))
    fit = fit_with_undeclared_heat(fewer, near=near, free=near.free, n_passes=1)
    (nominal,) = fit.nominals
    afresh = grid_of(segment.forcing.step_s, nominal.sample_of, fewer.segments[0].valid)
    np.testing.assert_array_equal(nominal.grid.interval, afresh.interval)


@pytest.mark.parametrize(
    "curvature",
    [1e-3 * np.eye(3), np.eye(3), 1e4 * np.eye(3), 1e204 * np.ones((3, 3))],
    ids=["1e-3", "1", "1e4", "none"],
)
def test_what_a_search_of_sizes_remembers_wrongly_does_not_hold_it_up(curvature: np.ndarray) -> None:
    """The heat was far larger or smaller when the slope's change was seen: passes come to the same sizes all the same.

    Of a start at which readings were as unlikely as exp(-1e204) it remembered a singular matrix, and the right name failed.
    """
    problem, _ = three_nodes(2, 20.0)
    fit = fit_with_undeclared_heat(problem)
    sizes = SizeSearch(0.1, curvature)
    found = replace(fit.undeclared, std_W=5.0 * fit.undeclared.std_W)
    value = -np.inf
    for _ in range(12):
        before, (found, value) = value, sizes.improve(problem, found, fit.nominals)
        assert value >= before
    assert value > fit.log_likelihood - 0.2


def test_a_first_start_that_fails_at_the_deadline_is_a_numerical_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but that ends a candidate and not the run: there is no second start after the deadline."""

    def fails(*arguments: object, **options: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    problem, _ = three_nodes(2, 20.0)
    monkeypatch.setattr("twin_core.calibrate.undeclared.fit._pass", fails)
    with pytest.raises(ArithmeticError):
        fit_with_undeclared_heat(problem, deadline=0.0)
    with pytest.raises(np.linalg.LinAlgError):
        fit_with_undeclared_heat(problem)


def hidden_wall(seed: int, n_times: int = 600) -> Problem:
    """Return a heated node before a wall that nobody reads, which has heat that nobody declared."""
    rng = np.random.default_rng(seed)
    capacity, time_s = np.array([3.0e3, 3.0e4]), 120.0 * np.arange(n_times)
    power = np.repeat(rng.choice([0.0, 60.0, 120.0], n_times // 15 + 1), 15)[:n_times]
    hidden = 80.0 * np.repeat(rng.choice([0.0, 1.0], n_times // 60 + 1), 60)[:n_times]
    rates = -(laplacian(2, [(0, 1)], [4.0]) + np.diag([0.0, 1.5])) / capacity[:, None]
    drive = np.stack([power, hidden + 1.5 * 270.0], axis=1) / capacity
    states = linear_states(rates, drive, np.array([285.0, 280.0]), time_s)
    power_channel = {"Q": {"kind": "power", "unit": "W"}}
    loads = [{"channel": "Q", "node": "n0"}]
    data = conductive_spec(2, [(0, 1)], channels=power_channel, loads=loads, boundaries={"room": {"value_K": 270.0}})
    del data["channels"][data["nodes"][1].pop("sensor")]
    data["conductors"].append({"between": ["n1", "room"], "conductance_W_per_K": {"guess": 2.0}})
    read = states[:, 0] + rng.normal(0.0, 0.1, n_times)
    return build_problem(build_network(load_spec(data)), [record_of(time_s, Q=power, T0=read)], np.array([0.1]), 1e9)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_fit_from_one_nearby_ends_about_its_own_temperatures(seed: int) -> None:
    """A law of a node that nobody reads must not be driven by what another fit has drawn from the readings about it."""
    problem = hidden_wall(seed)
    near = fit_with_undeclared_heat(problem)
    (start,) = CapacityTemperature.starts({"node": "n1"}, survey_of(near))
    rich = extended(problem, [start])
    free = np.append(near.free, rich.network.parameters.free[-1:])
    assert rich.network.parameters.free_names[:-1] == problem.network.parameters.free_names
    fit = fit_with_undeclared_heat(rich, free, near=near, n_passes=6)
    (nominal,) = fit.nominals
    states_K, heat_W, _ = smoothed_states(rich, fit.values, fit.undeclared, nominal)
    again = linearise(rich, fit.values, nominal.segment, states_K, heat_W[:-1], grid=nominal.grid)
    assert log_likelihood(rich, fit.undeclared, [again]) == pytest.approx(fit.log_likelihood, abs=0.2)
