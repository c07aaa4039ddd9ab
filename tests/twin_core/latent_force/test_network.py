"""A declared network with a radiator and inputs: the hidden heat is found through its own linearisation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.effects.leak_to_boundary import LeakToBoundary
from twin_core.gp.kernels import Matern
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.network import grid_times_s, linearise_network, on_grid
from twin_core.latent_force.smooth import smooth_extended
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.telemetry import Record

SPEC = {
    "twin": "t",
    "boundaries": {"space": {"value_K": 3.0}},
    "channels": {
        "T_a": {"kind": "temperature", "unit": "K"},
        "T_b": {"kind": "temperature", "unit": "K"},
        "Q": {"kind": "power", "unit": "W"},
        "L": {"kind": "power", "unit": "W", "interpolation": "linear"},
    },
    "nodes": [
        {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"value": 800.0}},
        {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"value": 2000.0}},
    ],
    "conductors": [{"between": ["a", "b"], "conductance_W_per_K": {"value": 1.5}}],
    "radiators": [{"node": "b", "emissivity": 0.8, "area_m2": 0.2, "sink": "space"}],
    "loads": [{"channel": "Q", "node": "a"}, {"channel": "L", "node": "b"}],
}
TIMES = np.arange(0.0, 6000.0, 60.0)
HELD = np.where(TIMES % 1800.0 < 900.0, 60.0, 10.0)
LINEAR = 15.0 + 10.0 * np.sin(TIMES / 700.0)


def _hidden(time_s):
    return 4.0 * np.sin(2.0 * np.pi * np.asarray(time_s) / 3000.0)


def _rates(t, x, k):
    exchange = 1.5 * (x[1] - x[0])
    radiated = SIGMA * 0.8 * 0.2 * (3.0**4 - x[1] ** 4)
    linear = np.interp(t, TIMES, LINEAR)
    return np.array([(HELD[k] + exchange) / 800.0, (linear - exchange + radiated + _hidden(t)) / 2000.0])


def _truth() -> np.ndarray:
    out = [np.array([265.0, 255.0])]
    for k in range(TIMES.size - 1):
        run = solve_ivp(_rates, TIMES[k : k + 2], out[-1], args=(k,), rtol=1e-10, atol=1e-9)
        out.append(run.y[:, -1])
    return np.array(out)


TRUTH = _truth()


def _forcing(max_step_s):
    network = build_network(load_spec(SPEC))
    record = Record(TIMES, {"T_a": TRUTH[:, 0], "T_b": TRUTH[:, 1], "Q": HELD, "L": LINEAR})
    return network, build_forcing(network, record, max_step_s)


@pytest.mark.parametrize("max_step_s", [60.0, 25.0])
def test_declared_rate_is_the_balance(max_step_s):
    """J T + c at the two ends of every step is dT/dt written out, but for the curvature of T⁴ inside the step."""
    network, forcing = _forcing(max_step_s)
    grid = grid_times_s(forcing)
    temperatures = np.stack([np.interp(grid, TIMES, column) for column in TRUTH.T], axis=1)
    found = linearise_network(network, forcing)(temperatures)
    for k in range(forcing.n_steps):
        sample = int(np.searchsorted(TIMES, grid[k], side="right")) - 1
        for end in (0, 1):
            at = grid[k + end]
            rate = found.jacobian_per_s[k] @ temperatures[k + end] + found.constant_K_per_s[k, end]
            expected = _rates(at, temperatures[k + end], sample) - np.array([0.0, _hidden(at) / 2000.0])
            np.testing.assert_allclose(rate, expected, atol=2e-6)
    np.testing.assert_allclose(found.capacity_J_per_K, [[800.0, 2000.0]] * found.capacity_J_per_K.shape[0])


@pytest.mark.parametrize("max_step_s", [60.0, 25.0])
def test_hidden_heat_is_found(max_step_s):
    """4 W of hidden heat on the radiating node, to 0.3 W, whether or not steps lie between the samples."""
    network, forcing = _forcing(max_step_s)
    samples = TRUTH + 0.01 * np.random.default_rng(0).normal(size=TRUTH.shape)
    about = linearise_network(network, forcing)
    model = ForceModel.build(
        about(np.full((forcing.n_steps + 1, 2), 260.0)),
        (1,),
        Matern(5),
        observation=np.eye(2),
        noise_std_K=[0.01, 0.01],
        prior_mean_K=TRUTH[0],
        prior_std_K=1.0,
    )
    found = smooth_extended(model, about, on_grid(forcing, samples), np.array([4.0, 1000.0]))
    assert found.converged
    wrong = (found.mean_W[:, 0] - _hidden(found.time_s))[forcing.sample_step]
    assert np.sqrt(np.mean(wrong[3:-3] ** 2)) < 0.3
    assert np.mean(np.abs(wrong) < 1.96 * found.std_W[forcing.sample_step, 0]) > 0.85


def test_a_registered_effect_is_part_of_the_network():
    """A wrong leak of 0.05 W/K carried by the network: the force supplies the hidden heat and gives the leak's back."""
    plain, forcing = _forcing(60.0)
    leak = LeakToBoundary({"node": "b", "boundary": "space"}, {"G_W_per_K": 0.05})
    network = build_network(plain.spec, [leak])
    about = linearise_network(network, forcing)
    temperatures = np.stack([np.interp(grid_times_s(forcing), TIMES, column) for column in TRUTH.T], axis=1)
    with_leak, without = about(temperatures), linearise_network(plain, forcing)(temperatures)
    np.testing.assert_allclose((with_leak.jacobian_per_s - without.jacobian_per_s)[:, 1, 1], -0.05 / 2000.0, rtol=1e-9)
    samples = TRUTH + 0.01 * np.random.default_rng(1).normal(size=TRUTH.shape)
    model = ForceModel.build(
        about(np.full((forcing.n_steps + 1, 2), 260.0)),
        (1,),
        Matern(5),
        observation=np.eye(2),
        noise_std_K=[0.01, 0.01],
        prior_mean_K=TRUTH[0],
        prior_std_K=1.0,
    )
    found = smooth_extended(model, about, on_grid(forcing, samples), np.array([10.0, 1000.0]))
    expected = _hidden(TIMES) - 0.05 * (3.0 - TRUTH[:, 1])
    wrong = found.mean_W[forcing.sample_step, 0] - expected
    assert found.converged and np.sqrt(np.mean(wrong[3:-3] ** 2)) < 0.4
