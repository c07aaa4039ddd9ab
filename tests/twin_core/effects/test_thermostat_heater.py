"""A thermostat: its cycle in closed form and against SciPy's events, however the record is cut."""

from unittest.mock import patch

import numpy as np
from scipy.integrate import solve_ivp

import twin_core.simulate.rollout as rollout_module
from tests.helpers import at_named, conductive_spec, every_term_network, points, record_of, survey_of
from twin_core.effects import REGISTRY
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.network.thermostat import switching
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.simulate.response import sensitivities

C, G, POWER_W, ON_K, OFF_K, WALL_K = 4.0e3, 0.6, 60.0, 280.0, 284.0, 250.0


def heated(time_s: np.ndarray, wall_K: np.ndarray) -> tuple[Network, Forcing]:
    """Return a heated node behind a wall."""
    channel = {"W": {"kind": "temperature", "unit": "K"}}
    spec = conductive_spec(1, [], boundaries={"wall": {"channel": "W"}}, channels=channel)
    spec["conductors"] = [{"between": ["n0", "wall"], "conductance_W_per_K": {"guess": 1.0}}]
    dt_s = float(time_s[1])
    settings = {"off_state_K": ON_K, "on_state_K": OFF_K, "rate_K_per_s": 8e-3, "delay_s": 2e-3 * dt_s}
    values = {"Q_W": POWER_W, "T_on_K": ON_K, "T_off_K": OFF_K}
    heater = REGISTRY["thermostat_heater"]({"node": "n0"}, values, settings)
    network = at_named(build_network(load_spec(spec), [heater]), {"C:n0": C, "G:n0|wall": G})
    return network, build_forcing(network, record_of(time_s, W=wall_K), dt_s)


def rolled(time_s: np.ndarray, wall_K: np.ndarray, start_K: float) -> np.ndarray:
    """Return its temperatures and memory, (n_times, 2)."""
    network, forcing = heated(time_s, wall_K)
    path = rollout_module.rollout(network, network.parameters.values, np.array([start_K, ON_K]), forcing)
    assert path.converged
    return path.at_samples(forcing.sample_step)


def test_its_cycle_has_the_period_of_the_closed_form() -> None:
    time_s = 2.0 * np.arange(4000)
    found = rolled(time_s, np.full(4000, WALL_K), 282.0)
    on = found[:, 1] > 0.5 * (ON_K + OFF_K)
    starts = time_s[1:][np.diff(on.astype(int)) > 0]
    hot = WALL_K + POWER_W / G
    cooling, heating = (OFF_K - WALL_K) / (ON_K - WALL_K), (hot - ON_K) / (hot - OFF_K)
    assert starts.size > 5
    np.testing.assert_allclose(np.diff(starts), C / G * np.log(cooling * heating), rtol=0.01)
    # The samples beside a switching miss the thresholds by what the node moves in a step.
    np.testing.assert_allclose([found[500:, 0].min(), found[500:, 0].max()], [ON_K, OFF_K], atol=0.03)


def driven_wall_K(time_s: np.ndarray | float) -> np.ndarray:
    return 255.0 + 35.0 * np.sin(2.0 * np.pi * np.asarray(time_s) / 9000.0)


def truth(time_s: np.ndarray, start_K: float) -> np.ndarray:
    """Return temperatures at the samples, switched at SciPy's events."""
    found, x, t, heated = np.empty_like(time_s), start_K, 0.0, start_K < ON_K
    while t < time_s[-1]:

        def crossing(t: float, y: np.ndarray, heated: bool = heated) -> float:
            return float(OFF_K - y[0] if heated else y[0] - ON_K)

        crossing.terminal, crossing.direction = True, -1.0  # type: ignore[attr-defined]
        part = solve_ivp(
            lambda t, y, heated=heated: (G * (driven_wall_K(t) - y) + POWER_W * heated) / C,
            (t, time_s[-1]),
            [x],
            events=crossing,
            dense_output=True,
            max_step=30.0,
            rtol=1e-9,
        )
        here = (time_s >= t) & (time_s <= part.t[-1])
        found[here] = part.sol(time_s[here])[0]
        x, t, heated = float(part.y[0, -1]), float(part.t[-1]), not heated
    return found


def test_a_rollout_switches_where_scipy_does() -> None:
    """Each instant is located within its step: the error falls with its square, though steps are as long as heating takes."""
    errors = []
    for dt_s in (40.0, 10.0):
        time_s = dt_s * np.arange(int(12_000.0 / dt_s))
        wrong = rolled(time_s, driven_wall_K(time_s), 290.0)[:, 0] - truth(time_s, 290.0)
        errors.append(float(np.sqrt(np.mean(wrong**2))))
    assert errors[0] < 2e-3
    assert errors[1] < 0.1 * errors[0]


def test_sensitivities_are_the_central_difference_through_its_switching() -> None:
    time_s = 40.0 * np.arange(200)
    network, forcing = heated(time_s, 250.0 + 5.0 * np.sin(time_s / 500.0))
    free = network.parameters.free
    at = np.concatenate([free, [281.0, 281.0]])

    def end(x: np.ndarray) -> np.ndarray:
        values = network.parameters.to_values(x[: free.size])
        path = rollout_module.rollout(network, values, x[free.size :], forcing)
        return path.at_samples(forcing.sample_step)

    path = rollout_module.rollout(network, network.parameters.values, at[free.size :], forcing)
    on = path.stages_K[:, 1, 1] > 0.5 * (ON_K + OFF_K)
    assert np.abs(np.diff(on.astype(int))).sum() >= 8
    columns = np.hstack([np.zeros((2, free.size)), np.eye(2)])
    values = network.parameters.values
    parts = sensitivities(network, values, forcing, path, columns, np.arange(2))
    found = np.concatenate([block for _, block in parts])
    for column in range(at.size):
        step = 1e-5 * np.eye(at.size)[column]
        expected = (end(at + step) - end(at - step))[:, 0] / 2e-5
        scale = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(found[:, 0, column], expected, atol=1e-6 * scale, err_msg=f"column {column}")


def test_it_remembers_wherever_a_rollout_is_cut() -> None:
    time_s = 20.0 * np.arange(1500)
    whole = rolled(time_s, driven_wall_K(time_s), 290.0)

    def in_pieces(n_steps: int, _: int) -> list[tuple[int, int]]:
        return [(first, min(first + 40, n_steps)) for first in range(0, n_steps, 40)]

    with patch.object(rollout_module, "stretches", in_pieces):
        cut = rolled(time_s, driven_wall_K(time_s), 290.0)
    np.testing.assert_allclose(cut[:, 0], whole[:, 0], atol=1e-6)


def test_between_its_thresholds_it_does_what_it_did() -> None:
    """Five steps of 10 s, begin and end of each: every step gets its heat, from the instant of a crossing on."""
    time_s = np.repeat(10.0 * np.arange(6), 2)[1:-1]
    temperature = np.repeat([282.0, 283.0, 279.0, 285.0, 281.0, 279.0], 2)[1:-1]
    relay = switching(time_s, temperature, ON_K, OFF_K, np.full(10, 0.25), 0.1)
    np.testing.assert_array_equal(relay.called, [0, 0, 0, 1, 1, -1, -1, -1, -1, 1])
    heated_s = 5.0 * (relay.share[0::2] + relay.share[1::2])
    # On after three quarters of the second step, with a quarter of full power before; off after five sixths of the third;
    # on after half of the last.
    np.testing.assert_allclose(heated_s, [2.5, 2.5 + 7.5 * 0.25, 10.0 * 5.0 / 6.0, 0.0, 5.0])
    # An instant later by the threshold's share of the way: a kelvin is half of it.
    np.testing.assert_allclose([relay.by_on[8:], relay.by_temperature[8:]], [[0.5, 0.5], [-0.5, -0.5]])


def test_thresholds_that_are_tried_stand_in_order_within_what_was_visited() -> None:
    network = every_term_network()
    survey = survey_of(network, points(network, 80))
    for start in REGISTRY["thermostat_heater"].starts({"node": "a"}, survey):
        assert survey.temperature_K("a").min() < start.values["T_on_K"] < start.values["T_off_K"]
        assert start.values["T_off_K"] < survey.temperature_K("a").max()
