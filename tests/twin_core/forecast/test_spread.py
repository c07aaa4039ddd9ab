"""What errors of parameters do to a filtered state, against the filter itself run with other parameters."""

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import conductive_spec, model_of, record_of
from twin_core.assimilate import assimilate
from twin_core.calibrate.result import CalibratedModel
from twin_core.forecast.spread import state_by_parameters
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

STEP_S, HEAT_W = 60.0, 12.0
NAMED = {"C:n0": 2.0e3, "C:n1": 8.0e3, "G:n0|n1": 3.0, "G:n1|room": 1.5}


def model(sensed: bool, misfit_K: float) -> CalibratedModel:
    """Two nodes before a room; the second is hidden unless sensed."""
    spec = conductive_spec(
        2,
        [(0, 1)],
        channels={"Q": {"kind": "power", "unit": "W"}},
        loads=[{"channel": "Q", "node": "n0"}],
        boundaries={"room": {"value_K": 280.0}},
    )
    spec["conductors"].append({"between": ["n1", "room"], "conductance_W_per_K": {"guess": 1.0}})
    if not sensed:
        del spec["nodes"][1]["sensor"], spec["channels"]["T1"]
    return model_of(load_spec(spec), NAMED, std=0.1, noise_K=0.3, misfit_K=misfit_K, max_step_s=STEP_S)


def record(made: CalibratedModel, n_samples: int) -> Record:
    """A steady state, without noise: 288 K at the second node with 12 W to the room, 292 K at the first."""
    second = 280.0 + HEAT_W / NAMED["G:n1|room"]
    first = second + HEAT_W / NAMED["G:n0|n1"]
    sensed = {"T1": np.full(n_samples, second)} if len(made.spec.sensors) > 1 else {}
    return record_of(
        STEP_S * np.arange(n_samples), T0=np.full(n_samples, first), Q=np.full(n_samples, HEAT_W), **sensed
    )


@pytest.mark.parametrize("misfit_K", [0.0, 2.0])
@pytest.mark.parametrize("sensed", [True, False])
def test_the_filter_follows_readings_in_spite_of_a_parameter(sensed: bool, misfit_K: float) -> None:
    made = model(sensed, misfit_K)
    telemetry = record(made, 4000)
    done = assimilate(made, telemetry)
    network = made.network()
    ahead = build_forcing(network, record(made, 20), made.max_step_s)
    path = rollout(network, network.parameters.values, done.mean_K, ahead)
    found = state_by_parameters(made, network, ahead, path, done.covariance_K2, STEP_S)

    assert found.shape == (2, len(made.free_names))
    change = 1e-4  # of the logarithm
    for column, name in enumerate(made.free_names):
        ends = []
        for sign in (1.0, -1.0):
            value = made.values[name] * np.exp(sign * change)
            ends.append(assimilate(replace(made, values=made.values | {name: value}), telemetry).mean_K)
        oracle = (ends[0] - ends[1]) / (2.0 * change)
        np.testing.assert_allclose(found[:, column], oracle, rtol=2e-3, atol=2e-3)


def test_steps_longer_than_the_sampling_take_readings_together() -> None:
    """To first order in the step: two minutes are a fifth of the faster time constant."""
    made = model(False, 2.0)
    done = assimilate(made, record(made, 4000))
    network = made.network()
    found = {}
    for step_s in (60.0, 120.0):
        driven = record_of(step_s * np.arange(3), T0=np.full(3, 290.0), Q=np.full(3, HEAT_W))
        ahead = build_forcing(network, driven, step_s)
        path = rollout(network, network.parameters.values, done.mean_K, ahead)
        found[step_s] = state_by_parameters(made, network, ahead, path, done.covariance_K2, STEP_S)
    np.testing.assert_allclose(found[120.0][1], found[60.0][1], rtol=0.2, atol=1e-9)
