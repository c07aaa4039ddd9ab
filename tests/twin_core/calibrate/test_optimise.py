"""The solver finds its way back from starts that are wrong by orders of magnitude."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from tests.helpers import at_named, conductive_spec, record_of
from twin_core.calibrate.normal_equations import normal_equations
from twin_core.calibrate.optimise import PACE_STEPS, minimise
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.effects import REGISTRY
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec

CAPACITY, G, WALL_G, WALL_K, AREA_M2 = np.array([800.0, 1200.0, 1000.0]), np.array([1.0, 1.5]), 2.0, 260.0, 0.2
TIME_S = 60.0 * np.arange(400)
HEAT_W = np.repeat(np.random.default_rng(4).choice([0.0, 60.0, 150.0], 20), 20)


def truth_K() -> np.ndarray:
    """Return the temperatures of a chain whose first two nodes radiate to each other besides, (n_times, 3)."""

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        along = np.array([G[0] * (x[1] - x[0]), G[1] * (x[2] - x[1])])
        radiated = STEFAN_BOLTZMANN_W_PER_M2_K4 * AREA_M2 * (x[1] ** 4 - x[0] ** 4)
        heat = np.array([along[0] + radiated, along[1] - along[0] - radiated, WALL_G * (WALL_K - x[2]) - along[1]])
        heat[0] += HEAT_W[min(int(t / 60.0), HEAT_W.size - 1)]
        return heat / CAPACITY

    found = [np.full(3, 285.0)]
    for start, stop in pairwise(TIME_S.tolist()):
        found.append(solve_ivp(rate, (start, stop - 1e-9), found[-1], rtol=1e-9, atol=1e-9).y[:, -1])
    return np.array(found)


def problem(start_m2: float) -> Problem:
    """Return the fit of that chain with an exchange area to start from; its conductors start where they stand for both."""
    wall = {"boundaries": {"wall": {"value_K": WALL_K}}}
    power = {"channels": {"Q": {"kind": "power", "unit": "W"}}, "loads": [{"channel": "Q", "node": "n0"}]}
    spec = conductive_spec(3, [(0, 1), (1, 2)], **wall, **power)
    spec["conductors"].append({"between": ["n2", "wall"], "conductance_W_per_K": {"guess": 1.0}})
    exchange = REGISTRY["radiative_exchange"]({"nodes": ["n0", "n1"]}, {"R_m2": start_m2})
    network = at_named(build_network(load_spec(spec), [exchange]), {"G:n0|n1": 2.2})
    readings = truth_K() + np.random.default_rng(1).normal(0.0, 0.02, (TIME_S.size, 3))
    record = record_of(TIME_S, Q=HEAT_W, **{f"T{i}": readings[:, i] for i in range(3)})
    return build_problem(network, [record], np.full(3, 0.02))


@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0, 30.0, 100.0])
def test_radiation_beside_a_declared_conductor_is_told_from_any_start(factor: float) -> None:
    """Far too large, it drags the conductor to nothing with it, and has to bring it back."""
    p = problem(factor * AREA_M2)
    optimum = minimise(p, accelerated=True)
    found = p.network.with_values(p.values(optimum.unknowns)).parameters.as_dict()
    np.testing.assert_allclose(found["radiative_exchange(n0,n1).R_m2"], AREA_M2, rtol=0.05)
    np.testing.assert_allclose(found["G:n0|n1"], G[0], rtol=0.1)


def warmed_by_one_step() -> Problem:
    """Return blocks in a row that one step of power warms by a few kelvin, read to half a millikelvin, in a room that is off.

    Capacities and losses nearly make up for each other here: the cost is a narrow valley, and it is curved.
    """
    conductors, capacities = [0.27, 0.15], [1400.0, 800.0, 250.0]
    losses, power_W, room_K = [0.25, 0.17, 0.09], 10.0, 297.5
    time_s = 20.0 * np.arange(360)

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        between = [conductors[0] * (x[1] - x[0]), conductors[1] * (x[2] - x[1])]
        heat = [power_W + between[0], between[1] - between[0], -between[1]]
        return (np.array(heat) + np.array(losses) * (room_K - x)) / np.array(capacities)

    start_K = np.full(3, room_K - 0.5)
    read = solve_ivp(rate, (0.0, time_s[-1]), start_K, t_eval=time_s, rtol=1e-9, atol=1e-9).y.T
    read = read + np.random.default_rng(5).normal(0.0, 5e-4, read.shape)
    spec = conductive_spec(
        3,
        [(0, 1), (1, 2)],
        boundaries={"room": {"channel": "room"}},
        channels={"P": {"kind": "power", "unit": "W"}, "room": {"kind": "temperature", "unit": "K"}},
        loads=[{"channel": "P", "node": "n0"}],
    )
    for i in range(3):
        spec["conductors"].append({"between": [f"n{i}", "room"], "conductance_W_per_K": {"guess": 0.5}})
    shifted = REGISTRY["boundary_offset"]({"boundary": "room"}, {"b_K": 0.0})
    network = build_network(load_spec(spec), [shifted])
    record = record_of(
        time_s, P=np.full(360, power_W), room=np.full(360, room_K - 0.5), **{f"T{i}": read[:, i] for i in range(3)}
    )
    return build_problem(network, [record], np.full(3, 5e-4))


def test_a_curved_valley_is_followed_to_its_end() -> None:
    """SciPy's trust region, given the same residuals and Jacobian and as many evaluations as it likes, gets no lower."""
    p = warmed_by_one_step()
    optimum = minimise(p, accelerated=True)
    mean, std = p.prior()

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([*(-r.ravel() / p.noise_K[0] for r in p.residuals(p.solve(x))), (x - mean) / std])

    def jacobian(x: np.ndarray) -> np.ndarray:
        (block,) = p.jacobian_blocks(x, p.solve(x))
        return np.vstack([block.reshape(-1, x.size) / p.noise_K[0], np.diag(1.0 / std)])

    peer = least_squares(
        residuals, p.start(), jacobian, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=None, max_nfev=3000
    )
    assert optimum.status == "converged"
    assert optimum.fit.cost <= peer.cost + 0.01


def test_what_a_step_bends_is_half_the_second_derivative() -> None:
    p = warmed_by_one_step()
    x, rng = p.start(), np.random.default_rng(2)
    step = 3e-3 * rng.normal(size=x.size)
    here, ahead, behind = p.solve(x), p.solve(x + step), p.solve(x - step)
    equations = normal_equations(p, x, here)
    half_K = 0.5 * (ahead.predicted_K[0] + behind.predicted_K[0]) - here.predicted_K[0]
    (block,) = p.jacobian_blocks(x, here)
    expected = np.einsum("tsi,ts->i", block / p.noise_K[0] ** 2, half_K)
    bent = 0.5 * (equations.curvature(here, ahead, step) + equations.curvature(here, behind, -step))
    np.testing.assert_allclose(bent, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_a_record_too_long_for_its_derivatives_is_fitted_without_them(monkeypatch: pytest.MonkeyPatch) -> None:
    p = problem(AREA_M2)
    monkeypatch.setattr("twin_core.calibrate.normal_equations.MOST_KEPT", 100)
    assert normal_equations(p, p.start(), p.solve(p.start())).slopes == ()
    optimum = minimise(p, accelerated=True)
    assert optimum.status == "converged"
    assert optimum.fit.cost < p.solve(p.start()).cost


def test_a_search_that_would_not_come_to_its_goal_is_given_up() -> None:
    p = problem(AREA_M2)
    free = minimise(p)
    given_up = minimise(p, goal=0.0)
    assert given_up.status == "given_up"
    assert PACE_STEPS <= given_up.iterations < free.iterations
    assert free.fit.cost <= given_up.fit.cost < p.solve(p.start()).cost


@pytest.mark.parametrize("factor", [0.1, 10.0, 30.0, 100.0])
def test_a_search_that_comes_to_its_goal_is_not_given_up(factor: float) -> None:
    p = problem(factor * AREA_M2)
    free = minimise(p)
    led = minimise(p, goal=1.01 * free.fit.cost)
    assert (led.status, led.iterations, led.fit.cost) == (free.status, free.iterations, free.fit.cost)
