"""One step from many states: equal to the rollout, with derivatives equal to central differences."""

import numpy as np

from tests.helpers import central_difference, every_term_network
from twin_core.network.model import Network
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.simulate.one_step import one_step
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record


def problem() -> tuple[Network, Forcing]:
    time_s = np.cumsum(np.random.default_rng(5).uniform(30.0, 200.0, 30))
    rng = np.random.default_rng(6)
    values = {
        "T_room": 290.0 + rng.normal(0, 2, 30),
        "Q_a": rng.uniform(0, 50, 30),
        "Q_sun": rng.uniform(0, 90, 30),
        "H": rng.uniform(0, 100, 30),
        "pitch": rng.uniform(40, 140, 30),
        "mode": rng.integers(0, 3, 30).astype(float),
    }
    network = every_term_network()
    return network, build_forcing(network, Record(time_s, values, epoch_ns=0), 60.0)


def test_steps_from_a_trajectory_end_on_it() -> None:
    network, forcing = problem()
    values = network.parameters.values
    path = rollout(network, values, np.array([280.0, 290.0, 270.0]), forcing)
    starts = np.vstack([path.start_K, path.stages_K[:-1, 1]])
    steps = one_step(network, values, forcing, starts)
    np.testing.assert_allclose(steps.stages_K, path.stages_K, atol=2e-6)  # both converged to 1e-6 K at least


def test_transition_and_heat_response_are_the_central_difference() -> None:
    network, forcing = problem()
    values = network.parameters.values
    rng = np.random.default_rng(7)
    starts = rng.uniform(260.0, 310.0, (forcing.n_steps, 3))
    heat = rng.normal(0.0, 20.0, (forcing.n_steps, 3))
    steps = one_step(network, values, forcing, starts, heat)
    for node in range(3):
        shift = np.zeros((forcing.n_steps, 3))
        shift[:, node] = 1.0

        def by_start(x: float, shift: np.ndarray = shift) -> np.ndarray:
            return one_step(network, values, forcing, starts + x * shift, heat).ends_K

        def by_heat(x: float, shift: np.ndarray = shift) -> np.ndarray:
            return one_step(network, values, forcing, starts, heat + x * shift).ends_K

        # Newton's last change is far below its limit of 1e-6 K: differences over 0.1 resolve 1e-7.
        np.testing.assert_allclose(steps.transition[:, :, node], central_difference(by_start, 0.0, 0.1), atol=1e-7)
        np.testing.assert_allclose(
            steps.heat_response_K_per_W[:, :, node], central_difference(by_heat, 0.0, 0.1), atol=1e-7
        )


def test_heat_held_over_a_step_is_a_load() -> None:
    network, forcing = problem()
    values = network.parameters.values
    starts = np.full((forcing.n_steps, 3), 285.0)
    extra = np.zeros((forcing.n_steps, 3))
    extra[:, 2] = 12.5
    loaded = {**forcing.inputs, "H": forcing.inputs["H"] + 12.5 / network.parameters.as_dict()["gain:H|c"]}
    other = Forcing(**{**vars(forcing), "inputs": loaded})
    with_heat = one_step(network, values, forcing, starts, extra).ends_K
    with_load = one_step(network, values, other, starts).ends_K
    np.testing.assert_allclose(with_heat, with_load, atol=2e-6)


def test_stages_close_by_lead_to_the_same_end() -> None:
    network, forcing = problem()
    values = network.parameters.values
    starts = np.full((forcing.n_steps, 3), 280.0)
    plain = one_step(network, values, forcing, starts)
    near = one_step(network, values, forcing, starts, near_K=plain.stages_K + 3.0)
    np.testing.assert_allclose(near.ends_K, plain.ends_K, atol=2e-6)
