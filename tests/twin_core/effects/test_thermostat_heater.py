"""A thermostat: its cycle in closed form and against SciPy's events, however the record is cut."""

from unittest.mock import patch

import numpy as np
from scipy.integrate import solve_ivp

import twin_core.simulate.rollout as rollout_module
from tests.helpers import at_named, conductive_spec, every_term_network, points, record_of, survey_of
from twin_core.effects import REGISTRY
from twin_core.effects.thermostat_heater import switching
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing

C, G, POWER_W, ON_K, OFF_K, WALL_K = 4.0e3, 0.6, 60.0, 280.0, 284.0, 250.0


def rolled(time_s: np.ndarray, wall_K: np.ndarray, start_K: float) -> np.ndarray:
    """Return temperatures and memory of a heated node behind a wall, (n_times, 2)."""
    channel = {"W": {"kind": "temperature", "unit": "K"}}
    spec = conductive_spec(1, [], boundaries={"wall": {"channel": "W"}}, channels=channel)
    spec["conductors"] = [{"between": ["n0", "wall"], "conductance_W_per_K": {"guess": 1.0}}]
    dt_s = float(time_s[1])
    settings = {"off_state_K": ON_K, "on_state_K": OFF_K, "rate_K_per_s": 8e-3, "delay_s": 2e-3 * dt_s}
    values = {"Q_W": POWER_W, "T_on_K": ON_K, "T_off_K": OFF_K}
    heater = REGISTRY["thermostat_heater"]({"node": "n0"}, values, settings)
    network = at_named(build_network(load_spec(spec), [heater]), {"C:n0": C, "G:n0|wall": G})
    forcing = build_forcing(network, record_of(time_s, W=wall_K), dt_s)
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
    # It overshoots its thresholds by what the node moves in a step.
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
    """Late by a share of a step each time: the error falls with the step."""
    errors = []
    for dt_s in (4.0, 1.0):
        time_s = dt_s * np.arange(int(12_000.0 / dt_s))
        wrong = rolled(time_s, driven_wall_K(time_s), 290.0)[:, 0] - truth(time_s, 290.0)
        errors.append(float(np.sqrt(np.mean(wrong**2))))
    assert errors[0] < 0.15
    assert errors[1] < 0.4 * errors[0]


def test_it_remembers_wherever_a_rollout_is_cut() -> None:
    time_s = 20.0 * np.arange(1500)
    whole = rolled(time_s, driven_wall_K(time_s), 290.0)
    with patch.object(rollout_module, "STRETCH", 40):
        cut = rolled(time_s, driven_wall_K(time_s), 290.0)
    np.testing.assert_allclose(cut[:, 0], whole[:, 0], atol=0.02)


def test_between_its_thresholds_it_does_what_it_did() -> None:
    """Steps of 10 s whose points stand at 3 s, for 7 s of heat, and at 10 s, for 3 s: each step gets its heat."""
    time_s = np.array([3.0, 10.0, 13.0, 20.0, 23.0, 30.0, 33.0, 40.0, 43.0, 50.0])
    temperature = np.array([282.0, 283.0, 281.0, 279.0, 281.0, 285.0, 283.0, 281.0, 279.0, 279.5])
    relay = switching(time_s, temperature, ON_K, OFF_K, np.full(10, 0.25), 0.1)
    np.testing.assert_array_equal(relay.called, [0, 0, 0, 1, 1, -1, -1, -1, 1, 1])
    heated_s = 7.0 * relay.share[0::2] + 3.0 * relay.share[1::2]
    # On after half of 13 s to 20 s, with a quarter of full power before; off after three quarters of 23 s to 30 s;
    # which 3 s had gone; on after half of 40 s to 43 s.
    np.testing.assert_allclose(heated_s, [2.5, 3.5 + 6.5 * 0.25, 3.0 + 0.75 * 7.0, 0.0, 1.5 + 7.0])
    np.testing.assert_allclose(relay.by_on[8], 3.0 / 7.0 / 2.0)


def test_thresholds_that_are_tried_stand_in_order_within_what_was_visited() -> None:
    network = every_term_network()
    survey = survey_of(network, points(network, 80))
    for start in REGISTRY["thermostat_heater"].starts({"node": "a"}, survey):
        assert survey.temperature_K("a").min() < start.values["T_on_K"] < start.values["T_off_K"]
        assert start.values["T_off_K"] < survey.temperature_K("a").max()
