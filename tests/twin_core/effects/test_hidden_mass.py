"""A mass behind a conductance: its lag against SciPy, its rollout against the matrix exponential."""

import numpy as np
import pytest
from scipy.signal import lsim

from tests.analytic import linear_states
from tests.helpers import at_named, conductive_spec, record_of
from twin_core.effects import REGISTRY
from twin_core.effects.hidden_mass import first_order_lag
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout


@pytest.mark.parametrize("tau_s", [1.0, 300.0, 1e6])
def test_the_lag_of_a_broken_line_is_exact(tau_s: float) -> None:
    time_s = 60.0 * np.arange(80)
    series = np.random.default_rng(3).uniform(270.0, 300.0, 80)
    _, expected, _ = lsim(([[-1.0 / tau_s]], [[1.0 / tau_s]], [[1.0]], [[0.0]]), series, time_s, X0=series[:1])
    np.testing.assert_allclose(first_order_lag(time_s, series, tau_s), expected, rtol=1e-9)


def test_the_lag_of_a_straight_line_trails_by_its_time_constant() -> None:
    time_s = np.cumsum(np.random.default_rng(0).uniform(1.0, 90.0, 400))
    lagged = first_order_lag(time_s, 0.01 * time_s, 200.0)
    np.testing.assert_allclose(lagged[-1], 0.01 * (time_s[-1] - 200.0), rtol=1e-9)


def test_repeated_instants_change_nothing() -> None:
    time_s = np.array([0.0, 10.0, 10.0, 20.0])
    series = np.array([1.0, 2.0, 2.0, 3.0])
    lagged = first_order_lag(time_s, series, 5.0)
    assert lagged[1] == lagged[2]
    np.testing.assert_allclose(lagged[[0, 1, 3]], first_order_lag(time_s[[0, 1, 3]], series[[0, 1, 3]], 5.0))


def test_a_node_with_a_hidden_mass_is_two_masses() -> None:
    power = {"kind": "power", "unit": "W"}
    spec = load_spec(conductive_spec(1, [], channels={"Q": power}, loads=[{"channel": "Q", "node": "n0"}]))
    effect = REGISTRY["hidden_mass"]({"node": "n0"}, {"C_J_per_K": 9.0e3, "G_W_per_K": 4.0})
    network = at_named(build_network(spec, [effect]), {"C:n0": 2.0e3})
    time_s = 120.0 * np.arange(60)
    heat = np.where(time_s < 3000.0, 50.0, 0.0)
    forcing = build_forcing(network, record_of(time_s, Q=heat), 5.0)
    found = rollout(network, network.parameters.values, np.array([300.0, 280.0]), forcing).at_samples(
        forcing.sample_step
    )
    rates = np.array([[-4.0 / 2.0e3, 4.0 / 2.0e3], [4.0 / 9.0e3, -4.0 / 9.0e3]])
    truth = linear_states(rates, np.outer(heat, [1.0 / 2.0e3, 0.0]), np.array([300.0, 280.0]), time_s)
    np.testing.assert_allclose(found, truth, atol=1e-4)
    assert network.nodes == ("n0", "n0.hidden_mass")
    np.testing.assert_array_equal(network.sensor_node, [0])


def test_its_time_constant_gives_its_capacity() -> None:
    start = REGISTRY["hidden_mass"]({"node": "n0"}, {"C_J_per_K": 1.0, "G_W_per_K": 0.0}, {"tau_s": 500.0})
    moved = start.with_amplitudes(np.array([3.0]))
    assert moved is not None
    assert moved.values == {"C_J_per_K": 1500.0, "G_W_per_K": 3.0}
    assert start.with_amplitudes(np.array([-3.0])) is None
