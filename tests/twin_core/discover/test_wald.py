"""By how many standard deviations effects move the readings: against refits of many draws of the noise, and confounded."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import curve_fit

from tests.twin_core.calibrate import body_with_gradients
from twin_core._typing import FloatArray
from twin_core.calibrate.second_order import fit_network
from twin_core.discover import wald
from twin_core.discover.trial import Trial, try_effects
from twin_core.discover.wald import least_wald_score, score_needed
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect
from twin_core.effects.straight_line import range_of_slope
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

C, G, ROOM_K, NOISE_K = 500.0, 0.8, 290.0, 0.1
STEP_S, N = 60.0, 240
TIME_S = STEP_S * np.arange(N)
SPEC = {
    "twin": "block",
    "boundaries": {"room": {"value_K": ROOM_K}},
    "channels": {
        "T": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K},
        "P": {"kind": "power", "unit": "W", "interpolation": "linear"},
    },
    "nodes": [{"id": "block", "sensor": "T", "capacity_J_per_K": {"guess": 400.0}}],
    "conductors": [{"between": ["block", "room"], "conductance_W_per_K": {"guess": 1.0}}],
    "loads": [{"channel": "P", "node": "block", "gain": {"value": 1.0}}],
}


def power_W(period_s: float) -> FloatArray:
    return 8.0 + 6.0 * np.sin(2.0 * np.pi * TIME_S / period_s)


def trials(effect: Effect, hidden_W: FloatArray, period_s: float) -> tuple[Trial, Trial]:
    """Return the declared model and the one with an effect, fitted to a block under a hidden heat."""
    heat_W = power_W(period_s) + hidden_W
    path = solve_ivp(
        lambda t, x: (np.interp(t, TIME_S, heat_W) - G * (x - ROOM_K)) / C,
        (0.0, TIME_S[-1]),
        [300.0],
        t_eval=TIME_S,
        rtol=1e-9,
        atol=1e-9,
        max_step=STEP_S,
    )
    measured = path.y[0] + NOISE_K * np.random.default_rng(5).standard_normal(N)
    record = Record(TIME_S, {"T": measured, "P": power_W(period_s)}, None, "block")
    fit, calibration = fit_network(load_spec(SPEC), [record])
    simple = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    return simple, try_effects(simple, (effect,), n_passes=12)


def block_K(theta: FloatArray) -> FloatArray:
    """Return the block's temperatures in closed form, of ln C, ln G, a constant load in W, and where it starts in K."""
    (c, g), load_W, start_K = np.exp(theta[:2]), theta[2], theta[3]
    heat_W, fade, lag_s = power_W(3000.0) + load_W, np.exp(-g * STEP_S / c), c / g
    slope = np.diff(heat_W) / STEP_S
    gain_K = (heat_W[:-1] * (1.0 - fade) + slope * (STEP_S - lag_s * (1.0 - fade))) / g
    path = [start_K - ROOM_K]
    for gain in gain_K:
        path.append(path[-1] * fade + gain)
    return ROOM_K + np.array(path)


def test_the_score_is_that_of_many_draws_of_the_noise() -> None:
    """SciPy refits the closed form to 300 records: how well what the load does is told beside all else."""
    effect = REGISTRY["constant_heat_load"]({"node": "block"}, {"Q_W": 1.0})
    simple, rich = trials(effect, np.full(N, 1.5), 3000.0)
    truth, rng = np.array([np.log(C), np.log(G), 1.5, 300.0]), np.random.default_rng(1)
    clean, done = block_K(truth), []
    for _ in range(300):
        record = clean + NOISE_K * rng.standard_normal(N)
        theta, _ = curve_fit(lambda t, *x: block_K(np.array(x)), TIME_S, record, p0=truth)
        done.append(block_K(theta) - block_K(theta * [1.0, 1.0, 0.0, 1.0]))
    oracle = np.sqrt((np.mean(done, axis=0) ** 2).sum() / np.var(done, axis=0).sum())
    assert least_wald_score(simple, rich) == pytest.approx(oracle, rel=0.2)


@pytest.mark.parametrize(("period_s", "is_told"), [(3000.0, False), (1900.0, True)], ids=["same period", "another one"])
def test_a_load_with_the_period_of_a_declared_input_has_no_size(period_s: float, is_told: bool) -> None:
    """Its share of the swing is what a smaller capacity would add to that of the input."""
    hidden = 2.0 * np.cos(2.0 * np.pi * TIME_S / period_s)
    effect = REGISTRY["periodic_heat_load"](
        {"node": "block"}, {"Q_W": 0.1, "A_W": 1.5, "B_W": 0.1, "P_s": period_s}, {"origin_s": 0.0, "dated": False}
    )
    simple, rich = trials(effect, hidden, 3000.0)
    assert rich.fit.log_posterior > simple.fit.log_posterior + 50.0
    assert (least_wald_score(simple, rich) > score_needed(np.log(100.0))) == is_told


PLATE_R_M2, PLATE_G, SIGMA = 0.05, 0.002, 5.670374419e-8


def radiating_trials() -> tuple[Trial, Trial]:
    """Return a plate with a film, as it is declared, and with the radiation that carries nearly all of its heat."""
    power = 40.0 + 30.0 * np.sign(np.sin(2.0 * np.pi * TIME_S / 5000.0))
    path = solve_ivp(
        lambda t, x: (
            (np.interp(t, TIME_S, power) - PLATE_G * (x - ROOM_K) - SIGMA * PLATE_R_M2 * (x**4 - ROOM_K**4)) / C
        ),
        (0.0, TIME_S[-1]),
        [330.0],
        t_eval=TIME_S,
        rtol=1e-9,
        atol=1e-9,
        max_step=STEP_S,
    )
    measured = path.y[0] + 5.0 * NOISE_K * np.random.default_rng(2).standard_normal(N)
    fit, calibration = fit_network(load_spec(SPEC), [Record(TIME_S, {"T": measured, "P": power}, None, "plate")])
    simple = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    radiation = REGISTRY["radiation_to_sink"]({"node": "block", "sink": "room"}, {"R_m2": 0.03})
    return simple, try_effects(simple, (radiation,), n_passes=12)


def along_trajectories(trial: Trial) -> tuple[wald._Fitted, FloatArray]:
    """Return what was fitted along trajectories, whatever gradients would explain, and the derivatives of its readings."""
    calibration = trial.calibration()
    problem, optimum = calibration.problem, calibration.optimum
    covariance = wald.trajectory_covariance(problem, optimum, calibration.whitener)
    slopes = wald.stacked_jacobian(problem, problem.jacobian_blocks(optimum.unknowns, optimum.fit))
    return wald._Fitted(problem, optimum, covariance), slopes


def test_an_effect_that_carries_most_of_the_heat_has_a_size() -> None:
    """Without the radiation the plate would hang on a film that nothing tells beside it."""
    simple, rich = radiating_trials()
    fitted, slopes = along_trajectories(rich)
    names = fitted.problem.network.parameters.free_names
    deviation = dict(zip(names, np.sqrt(np.diag(fitted.covariance)), strict=False))
    (own,) = (name for name in names if name.endswith("R_m2"))
    whole = wald._score(fitted, slopes, wald._without(fitted, simple.fit.problem, []))
    assert deviation["G:block|room"] > 0.5
    assert least_wald_score(simple, rich) == pytest.approx(1.0 / deviation[own], rel=0.2)
    assert whole < 0.2 / deviation[own]


@pytest.mark.parametrize("name", ["constant_heat_load", "input_gain"])
def test_of_heat_that_adds_up_a_part_tells_what_the_whole_does(name: str) -> None:
    where, values = {
        "constant_heat_load": ({"node": "block"}, {"Q_W": 1.0}),
        "input_gain": ({"channel": "P"}, {"g": 1.1}),
    }[name]
    simple, rich = trials(REGISTRY[name](where, values), np.full(N, 1.5), 3000.0)
    fitted, slopes = along_trajectories(rich)
    others = wald._without(fitted, simple.fit.problem, []), wald._with_less(fitted, rich.present_effects[0])
    whole, part = (wald._score(fitted, slopes, other) for other in others)
    assert part == pytest.approx(whole, rel=1e-3)


@pytest.mark.parametrize(("share_at_room", "is_told"), [(0.5, True), (0.0, False)])
def test_a_law_that_breaks_down_within_the_record_is_not_told(share_at_room: float, *, is_told: bool) -> None:
    """A conductance that falls to nothing at the coldest reading lies on the bound of its law: another law is true there."""
    mean_K = 0.5 * (294.0 + ROOM_K), 0.5 * (318.0 + ROOM_K)

    def rate(t: float, x: FloatArray) -> FloatArray:
        share = share_at_room + (1.0 - share_at_room) * (0.5 * (x + ROOM_K) - mean_K[0]) / (mean_K[1] - mean_K[0])
        return np.asarray((np.interp(t, TIME_S, power_W(3000.0)) - G * share * (x - ROOM_K)) / C)

    path = solve_ivp(rate, (0.0, TIME_S[-1]), [294.0], t_eval=TIME_S, rtol=1e-8, atol=1e-8, max_step=STEP_S)
    measured = path.y[0] + NOISE_K * np.random.default_rng(5).standard_normal(N)
    record = Record(TIME_S, {"T": measured, "P": power_W(3000.0)}, None, "block")
    fit, calibration = fit_network(load_spec(SPEC), [record])
    simple = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    reference_K = float(0.5 * (measured.mean() + ROOM_K))
    settings = {"T_ref_K": reference_K, **range_of_slope(0.5 * (measured + ROOM_K), reference_K)}
    effect = REGISTRY["conductance_temperature"]({"nodes": ("block", "room")}, {"beta_per_K": 1e-3}, settings)
    rich = try_effects(simple, (effect,), n_passes=12)
    assert (least_wald_score(simple, rich) > score_needed(4.6)) == is_told


def test_a_size_that_gradients_hide_is_told_beside_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """What sensors off the mean of their node read wanders along plain trajectories, as if it were noise with a memory.

    The oracle is the delta method by central differences, under dense noise with gradients of any size in its covariance.
    """
    fit, calibration = fit_network(load_spec(body_with_gradients.spec()), [body_with_gradients.record(1.0, heat_W=6.0)])
    simple = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    effect = REGISTRY["constant_heat_load"]({"node": "n0"}, {"Q_W": 4.0})
    rich = try_effects(simple, (effect,), n_passes=12)
    beside, (own,) = rich.beside_gradients(), rich.present_effects
    assert beside is not None
    assert beside.log_posterior > rich.calibration().log_posterior
    problem, covariance = beside.problem, body_with_gradients.dense_covariance(beside)
    at = problem.network.parameters.free_names.index(f"{own.label}.Q_W")

    def done_K(unknowns: FloatArray) -> FloatArray:
        without = unknowns.copy()
        without[at] = 0.0
        return problem.solve(unknowns).predicted_K[0] - problem.solve(without).predicted_K[0]

    steps = 1e-3 * np.diag(np.sqrt(np.diag(covariance)))
    unknowns = beside.optimum.unknowns
    slopes = np.array([(done_K(unknowns + h) - done_K(unknowns - h)).ravel() / (2.0 * h.max()) for h in steps]).T
    variance = np.einsum("ri,ij,rj->", slopes, covariance, slopes)
    score = least_wald_score(simple, rich)
    assert score == pytest.approx(np.sqrt((done_K(unknowns) ** 2).sum() / variance), rel=0.02)
    fitted, slopes = along_trajectories(rich)
    assert wald._score(fitted, slopes, wald._with_less(fitted, own)) < 0.5 * score
    on_a_bound = 0.3, np.inf  # along trajectories, and beside gradients
    monkeypatch.setattr(wald, "_scores_of_bounds", lambda one, effect: [on_a_bound[one.problem is problem]])
    assert least_wald_score(simple, rich) == on_a_bound[0]
