"""A late sensor: what it reads is the lag of its node, and a lag that vanishes reads the node itself."""

import numpy as np
import pytest

from tests.helpers import conductive_spec, every_term_network, points, record_of, survey_of
from twin_core.effects import REGISTRY
from twin_core.effects.hidden_mass import first_order_lag
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout

POWER = {"kind": "power", "unit": "W"}
SPEC = load_spec(conductive_spec(2, [(0, 1)], channels={"Q": POWER}, loads=[{"channel": "Q", "node": "n0"}]))


def lagging(tau_s: float) -> Network:
    return build_network(SPEC, [REGISTRY["sensor_lag"]({"sensor": "T0"}, {"tau_s": tau_s})])


def readings(network: Network, max_step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return sample times and all states."""
    time_s = 60.0 * np.arange(80)
    record = record_of(time_s, Q=np.where(np.arange(80) % 20 < 10, 80.0, 0.0))
    forcing = build_forcing(network, record, max_step_s)
    start = np.array([290.0, 285.0, 290.0])[: len(network.nodes)]
    path = rollout(network, network.parameters.values, start, forcing)
    return time_s, path.at_samples(forcing.sample_step)


def test_the_sensor_reads_the_added_state() -> None:
    network = lagging(200.0)
    assert network.nodes == ("n0", "n1", "T0.reading")
    np.testing.assert_array_equal(network.sensor_node, [2, 1])


def test_the_reading_is_the_lag_of_the_node() -> None:
    time_s, found = readings(lagging(200.0), 2.0)
    _, plain = readings(build_network(SPEC), 2.0)
    np.testing.assert_allclose(found[:, :2], plain, atol=1e-9)  # the node feels nothing of its sensor
    expected = first_order_lag(time_s, plain[:, 0], 200.0)
    # The node is curved between samples a minute apart: the lag of the broken line is off by h^2 T'' / 12.
    np.testing.assert_allclose(found[:, 2], expected, atol=2e-2)


def test_a_lag_that_vanishes_reads_the_node() -> None:
    _, found = readings(lagging(1e-6), 60.0)
    np.testing.assert_allclose(found[1:, 2], found[1:, 0], atol=1e-5)


def test_the_screening_sees_the_change_per_second_of_lag() -> None:
    network = every_term_network()
    along = points(network, 50)
    survey = survey_of(network, along)
    for start in REGISTRY["sensor_lag"].starts({"sensor": "T_a"}, survey):
        ((column,),) = start.unit_readings(survey)
        sensor, change = column
        tau = start.settings["start_s"]
        lagged = first_order_lag(along.time_s, along.temperatures_K[:, 0], tau)
        assert sensor == 0
        np.testing.assert_allclose(along.temperatures_K[:, 0] + tau * change, lagged, rtol=1e-12)


def test_a_negative_lag_is_not_physical() -> None:
    start = REGISTRY["sensor_lag"]({"sensor": "T0"}, {"tau_s": 0.0}, {"start_s": 10.0})
    assert start.with_amplitudes(np.array([-5.0])) is None
    moved = start.with_amplitudes(np.array([5.0]))
    assert moved is not None and moved.values["tau_s"] == pytest.approx(5.0)
