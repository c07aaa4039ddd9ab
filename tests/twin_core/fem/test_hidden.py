"""Hidden effects against a lumped model of two ideal plates, integrated by SciPy with the effect written by hand."""

import itertools
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.fem.hidden import AnyHiddenEffect
from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import Simulation, simulate

Maker = Callable[..., dict[str, Any]]
CAPACITY = {"a": 0.02 * 1e6, "b": 0.04 * 1e6, "c": 0.02 * 1e6}
JOINT_W_PER_K, ROOM_W_PER_K, RADIATOR_M2, SPACE_K, ROOM_K, POWER_W = 10.0, 3.0, 0.8 * 0.2, 3.0, 300.0, 20.0
STEP_TIME_S = 2000.0


def lumped(
    heat: Callable[[float, np.ndarray], tuple[float, float, float]] = lambda t, T: (0.0, 0.0, 0.0),
    *,
    power_W: Callable[[float], float] = lambda t: POWER_W,
    joint: Callable[[float, np.ndarray], float] = lambda t, T: 1.0,
    radiator: Callable[[float], float] = lambda t: 1.0,
    capacity: Callable[[np.ndarray], np.ndarray] = lambda T: np.array(list(CAPACITY.values())),
    breaks: tuple[float, ...] = (STEP_TIME_S,),
) -> Callable[[np.ndarray], np.ndarray]:
    """Return temperatures over time, (n_times, 3), of the plates a, b, c with hand-written extra heat."""

    def rate(t: float, T: np.ndarray) -> np.ndarray:
        flow = JOINT_W_PER_K * joint(t, T) * (T[1] - T[0])
        radiated = SIGMA * RADIATOR_M2 * radiator(t) * (SPACE_K**4 - T[0] ** 4)
        declared = np.array([power_W(t) + flow + radiated, -flow + ROOM_W_PER_K * (ROOM_K - T[1]), 0.0])
        return (declared + np.array(heat(t, T))) / capacity(T)

    def solve(times_s: np.ndarray) -> np.ndarray:
        edges = [0.0, *breaks, float(times_s[-1])]
        state, pieces = np.full(3, 290.0), []
        for start, stop in itertools.pairwise(edges):
            inside = times_s[(times_s >= start) & ((times_s < stop) | (stop == edges[-1]))]
            # Just inside the piece, so that a switch at its edge counts as done.
            run = solve_ivp(
                lambda t, T: rate(t + 1e-6, T),
                (start, stop),
                state,
                t_eval=np.union1d(inside, stop),
                rtol=1e-9,
                atol=1e-9,
            )
            pieces.append(run.y.T[: inside.size])
            state = run.y[:, -1]
        return np.concatenate(pieces)

    return solve


def level(t: float) -> int:
    return 2 if t >= 2000.0 else 0


def on_between(low: float, high: float) -> Callable[[float], float]:
    return lambda x: float(np.clip(x, low, high))


CASES: dict[str, tuple[dict[str, Any], Callable[[np.ndarray], np.ndarray]]] = {
    "radiation_to_sink": (
        {"node": "b", "sink": "space", "R_m2": 0.1},
        lumped(lambda t, T: (0.0, SIGMA * 0.1 * (SPACE_K**4 - T[1] ** 4), 0.0)),
    ),
    "radiative_exchange": (
        {"nodes": ["a", "c"], "R_m2": 0.3},
        lumped(lambda t, T: (q := SIGMA * 0.3 * (T[2] ** 4 - T[0] ** 4), 0.0, -q)),
    ),
    "missing_conductor": (
        {"nodes": ["a", "c"], "G_W_per_K": 2.0},
        lumped(lambda t, T: (2.0 * (T[2] - T[0]), 0.0, -2.0 * (T[2] - T[0]))),
    ),
    "leak_to_boundary": (
        {"node": "a", "boundary": "room", "G_W_per_K": 1.5},
        lumped(lambda t, T: (1.5 * (ROOM_K - T[0]), 0.0, 0.0)),
    ),
    "nonlinear_convection": (
        {"node": "c", "boundary": "room", "k": 0.4, "p": 1.33},
        lumped(lambda t, T: (0.0, 0.0, 0.4 * np.sign(ROOM_K - T[2]) * abs(ROOM_K - T[2]) ** 1.33)),
    ),
    "constant_heat_load": ({"node": "c", "Q_W": 12.0}, lumped(lambda t, T: (0.0, 0.0, 12.0))),
    "periodic_heat_load": (
        {"node": "b", "Q_W": 5.0, "A_W": 20.0, "B_W": -10.0, "P_s": 1500.0},
        lumped(
            lambda t, T: (
                0.0,
                5.0 + 20.0 * np.sin(2 * np.pi * t / 1500.0) - 10.0 * np.cos(2 * np.pi * t / 1500.0),
                0.0,
            )
        ),
    ),
    "channel_heat_load": (
        {"node": "c", "channel": "mode", "knots": [0, 1, 2], "values_W": [3.0, 8.0, -15.0]},
        lumped(lambda t, T: (0.0, 0.0, -15.0 if level(t) else 3.0)),
    ),
    "proportional_heater": (
        {"node": "a", "k_W_per_K": 4.0, "T_set_K": 292.0, "Q_W": 18.0},
        lumped(lambda t, T: (float(np.clip(4.0 * (292.0 - T[0]), 0.0, 18.0)), 0.0, 0.0)),
    ),
    "input_gain": ({"channel": "Q", "g": 1.7}, lumped(power_W=lambda t: 1.7 * POWER_W)),
    "input_power_law": (
        {"channel": "Q", "n": 1.5, "reference": 10.0},
        lumped(power_W=lambda t: POWER_W * (POWER_W / 10.0) ** 0.5),
    ),
    "input_step": (
        {"channel": "Q", "f": 0.0, "time": STEP_TIME_S},
        lumped(power_W=lambda t: 0.0 if t >= STEP_TIME_S else POWER_W),
    ),
    "input_drift": ({"channel": "Q", "r_per_s": 3e-4}, lumped(power_W=lambda t: POWER_W * (1.0 + 3e-4 * t))),
    "conductance_step": (
        {"nodes": ["a", "b"], "f": 0.3, "time": STEP_TIME_S},
        lumped(joint=lambda t, T: 0.3 if t >= STEP_TIME_S else 1.0),
    ),
    "conductance_temperature": (
        {"nodes": ["a", "b"], "beta_per_K": 0.05, "T_ref_K": 280.0},
        lumped(joint=lambda t, T: 1.0 + 0.05 * ((T[0] + T[1]) / 2.0 - 280.0)),
    ),
    "emissivity_step": (
        {"node": "a", "sink": "space", "f": 0.5, "time": STEP_TIME_S},
        lumped(radiator=lambda t: 0.5 if t >= STEP_TIME_S else 1.0),
    ),
    "capacity_temperature": (
        {"node": "a", "kappa_per_K": 0.05, "T_ref_K": 285.0},
        lumped(capacity=lambda T: np.array([2e4 * (1.0 + 0.05 * (T[0] - 285.0)), 4e4, 2e4])),
    ),
    "latent_heat": (
        {"node": "a", "L_J": 6e4, "T_m_K": 288.0, "w_K": 1.0},
        lumped(
            capacity=lambda T: np.array(
                [2e4 + 6e4 / np.sqrt(2 * np.pi) * np.exp(-((T[0] - 288.0) ** 2) / 2.0), 4e4, 2e4]
            )
        ),
    ),
}


def run(two_plates: Maker, **changes: Any) -> Simulation:
    """Simulate the two plates."""
    return simulate(load_scenario(two_plates(**changes)))


def test_without_effect_the_field_is_the_lumped_model(two_plates: Maker) -> None:
    """Ideal plates: field and lumped model agree; the default step of 20 s is second order, so 2 mK remain."""
    result = run(two_plates)
    lumped_K = lumped()(result.truth.time_s)
    for i, region in enumerate("abc"):
        np.testing.assert_allclose(result.truth.region_K[region], lumped_K[:, i], atol=2e-3)


@pytest.mark.parametrize("effect", list(CASES))
def test_effect_equals_its_formula(two_plates: Maker, effect: str) -> None:
    """The field with the effect follows the lumped model with the same effect written by hand, and moves by it."""
    fields, solution = CASES[effect]
    result = run(two_plates, hidden=[{"effect": effect} | fields])
    lumped_K, plain_K = solution(result.truth.time_s), lumped()(result.truth.time_s)
    assert np.abs(lumped_K - plain_K).max() > 0.2
    for i, region in enumerate("abc"):
        # Second-order steps of 20 s through kinks and jumps leave some mK.
        np.testing.assert_allclose(result.truth.region_K[region], lumped_K[:, i], atol=8e-3)
    assert result.truth.imbalance.max() < 1e-9


def test_hidden_mass_follows_behind_its_conductance(two_plates: Maker) -> None:
    """Against the four-node lumped model."""
    hidden = [{"effect": "hidden_mass", "node": "b", "C_J_per_K": 3e4, "G_W_per_K": 6.0}]
    result = run(two_plates, hidden=hidden)

    def rate(t: float, T: np.ndarray) -> list[float]:
        flow, behind = JOINT_W_PER_K * (T[1] - T[0]), 6.0 * (T[2] - T[1])
        first = POWER_W + flow + SIGMA * RADIATOR_M2 * (SPACE_K**4 - T[0] ** 4)
        return [first / 2e4, (-flow + behind + ROOM_W_PER_K * (ROOM_K - T[1])) / 4e4, -behind / 3e4]

    exact = solve_ivp(rate, (0, 6020), np.full(3, 290.0), t_eval=result.truth.time_s, rtol=1e-9, atol=1e-9).y
    np.testing.assert_allclose(result.truth.region_K["b"], exact[1], atol=2e-3)
    np.testing.assert_allclose(result.truth.region_K["a"], exact[0], atol=2e-3)


def test_thermostat_switches_with_hysteresis(two_plates: Maker) -> None:
    """The heater keeps the plate within its dead band once there, and is either on or off."""
    hidden = [
        {"effect": "constant_heat_load", "node": "c", "Q_W": -60.0},
        {"effect": "thermostat_heater", "node": "c", "Q_W": 150.0, "T_on_K": 286.0, "T_off_K": 288.0},
    ]
    truth = run(two_plates, hidden=hidden).truth
    later = truth.time_s > 2000.0
    # It looks once per 20 s step: -60 W or 90 W on 20 kJ/K move 0.06 K or 0.09 K meanwhile.
    assert 285.93 < truth.region_K["c"][later].min() < 286.0
    assert 288.0 < truth.region_K["c"][later].max() < 288.1
    np.testing.assert_array_equal(np.unique(np.round(truth.hidden_heat_W["c"][1:], 6)), [-60.0, 90.0])


def test_sensor_faults_touch_the_record_only(two_plates: Maker) -> None:
    """Bias, drift and lag change the readings as their formulas say; the field stays as it was."""
    hidden = [
        {"effect": "sensor_bias", "sensor": "T_a", "b_K": 1.5, "time": STEP_TIME_S},
        {"effect": "sensor_drift", "sensor": "T_b", "d_K_per_s": -1e-4},
        {"effect": "sensor_lag", "sensor": "T_c", "tau_s": 300.0},
        {"effect": "constant_heat_load", "node": "c", "Q_W": 20.0},
    ]
    result, plain = run(two_plates, hidden=hidden), run(two_plates)
    time_s, values = result.record.time_s, result.record.values
    for name in ("T_a", "T_b"):
        # The iteration of a step is shared by all plates, which leaves its tolerance between the two runs.
        np.testing.assert_allclose(result.truth.temperature_K[name], plain.truth.temperature_K[name], atol=1e-8)
    np.testing.assert_allclose(
        values["T_a"] - plain.record.values["T_a"], np.where(time_s >= STEP_TIME_S, 1.5, 0.0), atol=1e-8
    )
    np.testing.assert_allclose(values["T_b"] - plain.record.values["T_b"], -1e-4 * time_s, atol=1e-8)
    # A ramp of 1 mK/s seen through a lag tau trails by slope tau (1 - exp(-t / tau)).
    trailing = 290.0 + 1e-3 * (time_s - 300.0 * (1.0 - np.exp(-time_s / 300.0)))
    np.testing.assert_allclose(values["T_c"], trailing, atol=1e-6)


def test_truth_tells_the_hidden_heat(two_plates: Maker) -> None:
    """Lost input counts as negative heat in its region; an exchange sums to zero."""
    hidden = [
        {"effect": "input_gain", "channel": "Q", "g": 0.4},
        {"effect": "missing_conductor", "nodes": ["b", "c"], "G_W_per_K": 2.0},
    ]
    truth = run(two_plates, hidden=hidden).truth
    np.testing.assert_allclose(truth.hidden_heat_W["a"], -12.0)
    np.testing.assert_allclose(truth.hidden_heat_W["b"], -truth.hidden_heat_W["c"], atol=1e-9)
    assert np.abs(truth.hidden_heat_W["b"]).max() > 1.0


def test_every_registered_effect_is_tested_here() -> None:
    """Adding an effect without a formula in this file fails."""
    names = {get_args(member.model_fields["effect"].annotation)[0] for member in get_args(get_args(AnyHiddenEffect)[0])}
    elsewhere = {"hidden_mass", "thermostat_heater", "sensor_bias", "sensor_drift", "sensor_lag"}
    assert names == set(CASES) | elsewhere
