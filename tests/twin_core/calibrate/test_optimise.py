"""The solver finds its way back from starts that are wrong by orders of magnitude."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.helpers import at_named, conductive_spec, record_of
from twin_core.calibrate.optimise import minimise
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
    optimum = minimise(p)
    found = p.network.with_values(p.values(optimum.unknowns)).parameters.as_dict()
    np.testing.assert_allclose(found["radiative_exchange(n0,n1).R_m2"], AREA_M2, rtol=0.05)
    np.testing.assert_allclose(found["G:n0|n1"], G[0], rtol=0.1)
