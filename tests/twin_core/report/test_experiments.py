"""The experiment that would separate what the record cannot: what is promised is what SciPy integrates."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.stats import norm

from twin_core.calibrate.second_order import fit_network
from twin_core.discover.evidence import Evidence
from twin_core.discover.judge import Finding, Judged
from twin_core.discover.screen import screen, survey_of
from twin_core.discover.trial import Trial, try_effects
from twin_core.effects.constant_heat_load import ConstantHeatLoad
from twin_core.effects.leak_to_boundary import LeakToBoundary
from twin_core.network.spec import TwinSpec
from twin_core.report.experiments import (
    entropy_bits,
    information_bits,
    keeps_limits,
    plans,
    separating,
)
from twin_core.telemetry import Record

CAPACITY, LOSS, LEAK, NOISE_K, WALL_K, POWER_W = 900.0, 1.5, 0.5, 0.05, 270.0, 40.0
TIMES = 60.0 * np.arange(200)
SPEC = TwinSpec.model_validate(
    {
        "twin": "t",
        "boundaries": {"wall": {"value_K": WALL_K}, "room": {"value_K": 280.0}},
        "channels": {
            "T_a": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K},
            "Q": {"kind": "power", "unit": "W"},
        },
        "nodes": [{"id": "a", "sensor": "T_a", "capacity_J_per_K": {"value": CAPACITY}}],
        "conductors": [{"between": ["a", "wall"], "conductance_W_per_K": {"value": LOSS}}],
        "loads": [{"channel": "Q", "node": "a"}],
    }
)


def readings(power: np.ndarray, start_K: float, leak: float, heat_W: float) -> np.ndarray:
    """Integrate one node with a leak to the room and a constant heat, (n_times,)."""
    out = [np.array([start_K])]
    for k, watts in enumerate(power[:-1]):

        def rate(_: float, x: np.ndarray, watts: float = watts) -> list[float]:
            return [(watts + LOSS * (WALL_K - x[0]) + leak * (280.0 - x[0]) + heat_W) / CAPACITY]

        out.append(solve_ivp(rate, TIMES[k : k + 2], out[-1], rtol=1e-10, atol=1e-10).y[:, -1])
    return np.array(out)[:, 0]


@pytest.fixture(scope="module")
def finding() -> Finding:
    """A leak, and the constant heat that it looks like at a power that hardly moves."""
    power = POWER_W + np.where(np.arange(TIMES.size) % 40 < 20, 0.5, -0.5)
    measured = readings(power, 291.0, LEAK, 0.0) + NOISE_K * np.random.default_rng(0).normal(size=TIMES.size)
    fit, calibration = fit_network(SPEC, [Record(TIMES, {"T_a": measured, "Q": power})])
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    survey = survey_of(fit)
    starts = [
        screen(fit, survey, kind.starts(where, survey)).probes[0].effect
        for kind, where in ((LeakToBoundary, {"node": "a", "boundary": "room"}), (ConstantHeatLoad, {"node": "a"}))
    ]
    own, other = (Judged((e,), Evidence(9.0, 0.0), try_effects(base, [e], n_passes=15)) for e in starts)
    return Finding(own, (other,))


def test_promised_separation_is_what_scipy_integrates(finding: Finding) -> None:
    off = next(e for e in separating(finding) if e.words.startswith("Q off for 5970"))
    power = np.where(TIMES >= TIMES[-1] - 5970.0, 0.0, finding.judged.trial.fit.problem.segments[0].record.values["Q"])
    paths = []
    for judged in (finding.judged, finding.alternatives[0]):
        values = judged.trial.calibration().network.parameters.as_dict()
        leak = values.get("leak_to_boundary(a,room).G_W_per_K", 0.0)
        heat = values.get("constant_heat_load(a).Q_W", 0.0)
        start = float(judged.trial.calibration().optimum.fit.trajectories[0].start_K[0])
        paths.append(readings(power, start, leak, heat))
    assert off.apart_K == pytest.approx(np.sqrt(np.mean((paths[0] - paths[1]) ** 2)), rel=5e-3)
    assert off.apart_std == pytest.approx(off.apart_K / NOISE_K)
    assert off.decides and off.sensor == "T_a"


def test_moving_the_input_tells_more_than_the_same_again(finding: Finding) -> None:
    best, *_, worst = separating(finding)
    assert best.words.startswith("Q off")
    assert best.apart_std >= worst.apart_std


def test_nothing_to_separate_without_an_alternative(finding: Finding) -> None:
    assert separating(Finding(finding.judged)) == []


def gain_by_quadrature(means: list[float], stds: list[float], weights: list[float]) -> float:
    """Integrate the mutual information of an option and one normal reading, in bits."""
    laws = [norm(m, s) for m, s in zip(means, stds, strict=True)]

    def mixed(y: float) -> float:
        return sum(w * law.pdf(y) for w, law in zip(weights, laws, strict=True))

    ends = (min(means) - 9.0 * max(stds), max(means) + 9.0 * max(stds))
    marginal, _ = quad(lambda y: -mixed(y) * np.log2(max(mixed(y), 1e-300)), *ends, limit=400, points=means)
    return marginal - sum(w * law.entropy() / np.log(2.0) for w, law in zip(weights, laws, strict=True))


@pytest.mark.parametrize("weights", [[0.5, 0.5, 0.0], [0.8, 0.15, 0.05], [0.2, 0.3, 0.5]])
@pytest.mark.parametrize("apart", [0.0, 0.7, 2.0, 12.0])
def test_the_expected_gain_is_that_of_quadrature(apart: float, weights: list[float]) -> None:
    """One direction of many readings tells: along it option k lies at k * apart, and the second is less certain of it."""
    along = np.array([0.6, 0.0, 0.8])
    spreads = [0.0, 1.5, 0.0]
    predicted = [(10.0 + k * apart * along, s * along[:, None]) for k, s in enumerate(spreads)]
    stds = [float(np.hypot(1.0, s)) for s in spreads]
    expected = gain_by_quadrature([k * apart for k in range(3)], stds, weights)
    found = information_bits(predicted, np.array(weights), n_draws=20_000)
    assert found == pytest.approx(expected, abs=0.02)
    assert found <= entropy_bits(np.array(weights)) + 1e-12


def test_a_difference_that_parameters_can_take_up_tells_nothing() -> None:
    direction = np.linspace(0.0, 30.0, 50)
    certain = np.zeros((50, 1))
    vague = 10.0 * direction[:, None]
    told = information_bits([(np.zeros(50), certain), (direction, certain)], np.array([0.5, 0.5]))
    taken_up = information_bits([(np.zeros(50), vague), (direction, vague)], np.array([0.5, 0.5]))
    assert told == pytest.approx(1.0, abs=0.01)
    assert taken_up < 0.02


def test_what_the_record_hardly_determines_tells_nothing_and_drowns_nothing() -> None:
    """A direction known to 1e10 noises, common to both options, is only lost: the rest tells what it tells without it."""
    apart, vague = np.zeros(50), np.zeros((50, 2))
    apart[3], vague[7, 0], vague[9] = 2.0, 1e10, (3e9, 1e9)
    told = information_bits([(np.zeros(50), vague), (apart, vague)], np.array([0.5, 0.5]), n_draws=20_000)
    expected = gain_by_quadrature([0.0, 2.0], [1.0, 1.0], [0.5, 0.5])
    assert told == pytest.approx(expected, abs=0.02)


def test_an_experiment_without_finite_numbers_is_a_numerical_failure() -> None:
    wrong = np.full((5, 1), np.nan)
    with pytest.raises(ArithmeticError, match="not finite"):
        information_bits([(np.zeros(5), wrong), (np.ones(5), wrong)], np.array([0.5, 0.5]))


def test_the_best_experiment_gains_most_and_no_more_than_there_is(finding: Finding) -> None:
    found = separating(finding)
    gains = [experiment.gain_bits for experiment in found]
    assert gains == sorted(gains, reverse=True) and gains[0] > 0.9
    assert {experiment.entropy_bits for experiment in found} == {1.0}
    assert found[0].row()["plan"]["channel"] == "Q"


def test_inputs_keep_to_their_limits_and_sunlight_is_not_moved() -> None:
    channels = SPEC.model_dump(exclude_none=True)["channels"] | {"S": {"kind": "power", "unit": "W"}}
    channels["Q"]["limits"] = {"red": [0.0, 60.0], "yellow": [5.0, None]}
    loads = [{"channel": "Q", "node": "a"}, {"channel": "S", "node": "a", "solar": True}]
    spec = TwinSpec.model_validate(SPEC.model_dump(exclude_none=True) | {"channels": channels, "loads": loads})
    record = Record(TIMES, {"T_a": np.full(200, 280.0), "Q": np.full(200, 40.0), "S": np.arange(200.0)})
    values = {(plan.channel, plan.value) for plan in plans(spec, record)}
    assert values == {(None, None), ("Q", 5.0), ("Q", 60.0)}


def test_no_option_may_leave_the_limits_of_a_temperature() -> None:
    channels = SPEC.model_dump(exclude_none=True)["channels"]
    channels["T_a"] |= {"unit": "degC", "limits": {"yellow": [-5.0, None], "red": [-20.0, 40.0]}}
    spec = TwinSpec.model_validate(SPEC.model_dump(exclude_none=True) | {"channels": channels})
    inside = np.array([[268.2], [313.1]])
    assert keeps_limits(spec, inside)
    assert not any(keeps_limits(spec, inside + by) for by in (-0.1, 0.1))
    assert not keeps_limits(spec, np.array([[np.nan]]))
    assert keeps_limits(SPEC, np.array([[1000.0]]))
