"""Members of an ensemble against matrix exponentials and SciPy, each by itself."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.analytic import SIGMA, laplacian, linear_states
from tests.helpers import at_named, conductive_spec, record_of
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.simulate.splitting import LONGEST_STRETCH
from twin_core.simulate.together import Variants, rollouts

START_K = np.array([300.0, 280.0])
CAPACITY_J_PER_K, CONDUCTANCE_W_PER_K, RADIATING_M2 = np.array([3.0e3, 8.0e3]), 2.0, 0.05
STEP_S = 60.0


def network(*, is_radiating: bool = False) -> Network:
    body = conductive_spec(
        2,
        [(0, 1)],
        channels={"Q": {"kind": "power", "unit": "W"}, "T_room": {"kind": "temperature", "unit": "K"}},
        loads=[{"channel": "Q", "node": "n0"}],
        boundaries={"room": {"channel": "T_room"}},
    )
    if is_radiating:
        body["radiators"] = [{"node": "n1", "emissivity": 1.0, "area_m2": RADIATING_M2, "sink": "room"}]
    else:
        body["conductors"].append({"between": ["n1", "room"], "conductance_W_per_K": {"value": CONDUCTANCE_W_PER_K}})
    named = {f"C:n{i}": float(c) for i, c in enumerate(CAPACITY_J_PER_K)}
    return at_named(build_network(load_spec(body)), named | {"G:n0|n1": CONDUCTANCE_W_PER_K})


def members(net: Network, n_steps: int, powers_W: np.ndarray, rooms_K: np.ndarray) -> np.ndarray:
    """Return the states after every step with constant power and room of each member, (n_members, n_steps + 1, 2)."""
    time_s = STEP_S * np.arange(n_steps + 1.0)
    forcing = build_forcing(net, record_of(time_s, Q=10.0, T_room=285.0), np.inf)
    near = rollout(net, net.parameters.values, START_K, forcing)
    shape = (powers_W.size, n_steps, 2)
    variants = Variants(
        {"Q": np.broadcast_to(powers_W[:, None, None], shape)},
        {0: np.broadcast_to(rooms_K[:, None, None], shape)},
        powers_W.size,
    )
    return rollouts(net, net.parameters.values, forcing, near, variants, np.arange(2), np.arange(n_steps + 1))


def test_members_of_a_linear_network_are_matrix_exponentials() -> None:
    """Over more than a stretch, after which the modes are taken anew."""
    n_steps, powers_W, rooms_K = LONGEST_STRETCH + 50, np.array([0.0, 10.0, 35.0]), np.array([250.0, 285.0, 290.0])
    found = members(network(), n_steps, powers_W, rooms_K)
    coupling = laplacian(2, [(0, 1)], [CONDUCTANCE_W_PER_K]) + np.diag([0.0, CONDUCTANCE_W_PER_K])
    time_s = STEP_S * np.arange(n_steps + 1.0)
    for k, (power_W, room_K) in enumerate(zip(powers_W, rooms_K, strict=True)):
        rate = np.array([power_W, CONDUCTANCE_W_PER_K * room_K]) / CAPACITY_J_PER_K
        truth = linear_states(-coupling / CAPACITY_J_PER_K[:, None], np.tile(rate, (time_s.size, 1)), START_K, time_s)
        np.testing.assert_allclose(found[k], truth, atol=1e-7)


def test_members_that_radiate_are_those_of_scipy() -> None:
    n_steps, powers_W, rooms_K = 200, np.linspace(0.0, 60.0, 20), np.linspace(3.0, 300.0, 20)
    found = members(network(is_radiating=True), n_steps, powers_W, rooms_K)
    for k in (0, 7, 19):

        def rates(_: float, state: np.ndarray, k: int = k) -> np.ndarray:
            flow = CONDUCTANCE_W_PER_K * (state[1] - state[0])
            lost = SIGMA * RADIATING_M2 * (state[1] ** 4 - rooms_K[k] ** 4)
            return np.array([powers_W[k] + flow, -flow - lost]) / CAPACITY_J_PER_K

        truth = solve_ivp(rates, (0.0, n_steps * STEP_S), START_K, rtol=1e-10, atol=1e-9).y[:, -1]
        np.testing.assert_allclose(found[k, -1], truth, atol=2e-4)  # the scheme is of second order in steps of a minute


@pytest.mark.parametrize("power_W", [1e12, -1e6])
def test_a_member_without_a_solution_leaves_the_others_as_they_are(power_W: float) -> None:
    net = network(is_radiating=True)
    room_K = np.full(2, 285.0)
    alone = members(net, 30, np.full(1, 20.0), room_K[:1])
    found = members(net, 30, np.array([20.0, power_W]), room_K)
    np.testing.assert_allclose(found[0], alone[0], atol=1e-7)
    assert np.isnan(found[1, -1]).all()
