"""A name stands for a law: what merely resembles the missing heat leaves the difference behind. Readings are SciPy's."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.calibrate.second_order import fit_network
from twin_core.discover import form
from twin_core.discover.evidence import Evidence, weigh
from twin_core.discover.form import Repeatable, acts_at, against_free_forms, more_is_left_elsewhere, repeatable_heat
from twin_core.discover.judge import Finding, Judged, Search, most_left, threshold
from twin_core.discover.revision import prune
from twin_core.discover.screen import screen, survey_of
from twin_core.discover.trial import Trial, try_effects
from twin_core.effects.constant_heat_load import ConstantHeatLoad
from twin_core.effects.leak_to_boundary import LeakToBoundary
from twin_core.effects.proportional_heater import ProportionalHeater
from twin_core.effects.radiation_to_sink import RadiationToSink
from twin_core.errors import PrecisionError
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record

CAPACITY, LEAK, NOISE_K, WALL_K = 900.0, 1.5, 0.03, 270.0
TIMES = 60.0 * np.arange(300)
POWER = np.repeat(np.random.default_rng(0).uniform(0.0, 40.0, 15), 20)
SPEC = TwinSpec.model_validate(
    {
        "twin": "t",
        "boundaries": {"wall": {"value_K": WALL_K}},
        "channels": {
            "T_a": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K},
            "Q": {"kind": "power", "unit": "W"},
        },
        "nodes": [{"id": "a", "sensor": "T_a", "capacity_J_per_K": {"value": CAPACITY}}],
        "conductors": [{"between": ["a", "wall"], "conductance_W_per_K": {"value": LEAK}}],
        "loads": [{"channel": "Q", "node": "a"}],
    }
)
COUPLING = 0.8
PAIR = TwinSpec.model_validate(
    {
        "twin": "pair",
        "boundaries": {"wall": {"value_K": WALL_K}},
        "channels": {f"T_{n}": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K} for n in "ab"}
        | {f"Q_{n}": {"kind": "power", "unit": "W"} for n in "ab"},
        "nodes": [{"id": n, "sensor": f"T_{n}", "capacity_J_per_K": {"value": CAPACITY}} for n in "ab"],
        "conductors": [
            *({"between": [n, "wall"], "conductance_W_per_K": {"value": LEAK}} for n in "ab"),
            {"between": ["a", "b"], "conductance_W_per_K": {"value": COUPLING}},
        ],
        "loads": [{"channel": f"Q_{n}", "node": n} for n in "ab"],
    }
)
NEEDED = threshold(0.01)


def heater(temperature_K: float) -> float:
    """Return the heat of a proportional heater."""
    return float(np.clip(1.2 * (288.0 - temperature_K), 0.0, 9.0))


def resonance(temperature_K: float) -> float:
    """Return a heat that is largest at one temperature: on its warm side it falls to nothing as a heater's does."""
    return 12.0 * float(np.exp(-0.5 * ((temperature_K - 281.0) / 4.0) ** 2))


def record_of(heat_W: Callable[[float], float]) -> Record:
    """Return the readings of a world with hidden heat."""
    readings = [np.array([282.0])]
    for k, power in enumerate(POWER[:-1]):

        def rate(_: float, x: np.ndarray, power: float = power) -> list[float]:
            return [(power + LEAK * (WALL_K - x[0]) + heat_W(x[0])) / CAPACITY]

        readings.append(solve_ivp(rate, TIMES[k : k + 2], readings[-1], rtol=1e-9, atol=1e-9).y[:, -1])
    noise = NOISE_K * np.random.default_rng(1).normal(size=TIMES.size)
    return Record(TIMES, {"T_a": np.array(readings)[:, 0] + noise, "Q": POWER})


def declared(spec: TwinSpec, record: Record) -> Trial:
    """Return the declared model, fitted."""
    fit, calibration = fit_network(spec, [record])
    return Trial((), fit, calibration.max_step_s, (calibration.optimum,))


def named(heat_W: Callable[[float], float]) -> tuple[Trial, Trial]:
    """Return the declared model, and that with a proportional heater, fitted to readings of a world with hidden heat."""
    base = declared(SPEC, record_of(heat_W))
    fit, survey = base.fit, survey_of(base.fit)
    probes = screen(fit, survey, ProportionalHeater.starts({"node": "a"}, survey)).probes[:3]
    trials = [try_effects(base, [probe.effect], n_passes=15) for probe in probes]
    return base, max(trials, key=lambda trial: trial.fit.log_posterior)


@pytest.mark.parametrize(("heat_W", "left"), [(heater, False), (resonance, True)])
def test_a_law_that_only_resembles_the_heat_leaves_some_behind(heat_W: Callable[[float], float], left: bool) -> None:
    base, trial = named(heat_W)
    worth = weigh(base, trial, 1).log_bayes_factor
    assert worth > NEEDED  # either way the heater looks well supported
    most = most_left(worth, NEEDED)
    here = acts_at(trial, trial.effects)
    beside, instead = against_free_forms(base, trial, here, trial.effects, NEEDED, most)
    assert beside == repeatable_heat(trial, here, NEEDED)
    assert (beside.log_bayes_factor > most) is left
    assert (instead is not None) is left
    assert against_free_forms(base, trial, (), trial.effects, NEEDED, most) == (Repeatable(), instead)


@pytest.mark.parametrize("law", ["radiation", "leak", "constant"])
def test_a_smooth_law_is_not_outdone_by_the_free_form_that_contains_it(law: str) -> None:
    """A polynomial of temperature holds a leak and a load exactly, radiation nearly: then the name stands."""
    heat = {
        "radiation": (lambda x: -0.06 * 5.670374419e-8 * (x**4 - WALL_K**4), RadiationToSink, "sink", "R_m2"),
        "leak": (lambda x: 0.4 * (WALL_K - x), LeakToBoundary, "boundary", "G_W_per_K"),
        "constant": (lambda x: 5.0, ConstantHeatLoad, None, "Q_W"),
    }[law]
    hidden, kind, key, size = heat
    base = declared(SPEC, record_of(hidden))
    effect = kind({"node": "a"} | ({key: "wall"} if key else {}), {size: 0.05})
    trial = try_effects(base, [effect], n_passes=15)
    worth = weigh(base, trial, 1).log_bayes_factor
    assert worth > NEEDED
    _, instead = against_free_forms(base, trial, (), trial.effects, NEEDED, most_left(worth, NEEDED))
    assert instead is None


def pair_record(heats_W: Sequence[Callable[[float], float]]) -> Record:
    """Return the readings of two of these nodes, coupled, each with a hidden heat of its own and the power in turn."""
    powers = [POWER, np.roll(POWER, 100)]
    readings = [np.array([282.0, 282.0])]
    for k in range(TIMES.size - 1):

        def rate(_: float, x: np.ndarray, k: int = k) -> list[float]:
            exchanged = COUPLING * (x[1] - x[0])
            own = [p[k] + LEAK * (WALL_K - t) + heat(t) for p, t, heat in zip(powers, x, heats_W, strict=True)]
            return [(own[0] + exchanged) / CAPACITY, (own[1] - exchanged) / CAPACITY]

        readings.append(solve_ivp(rate, TIMES[k : k + 2], readings[-1], rtol=1e-9, atol=1e-9).y[:, -1])
    measured = np.array(readings) + NOISE_K * np.random.default_rng(1).normal(size=(TIMES.size, 2))
    return Record(TIMES, {"T_a": measured[:, 0], "T_b": measured[:, 1], "Q_a": powers[0], "Q_b": powers[1]})


@pytest.mark.parametrize(
    ("heats_W", "elsewhere"),
    [((heater, resonance), True), ((resonance, lambda x: 0.0), False), ((heater, lambda x: 0.0), False)],
    ids=["the other node lacks a heat", "no law", "the law"],
)
def test_what_repeats_elsewhere_is_no_remainder_of_a_name(
    heats_W: tuple[Callable[[float], float], Callable[[float], float]], elsewhere: bool
) -> None:
    base = declared(PAIR, pair_record(heats_W))
    fit, survey = base.fit, survey_of(base.fit)
    probes = screen(fit, survey, ProportionalHeater.starts({"node": "a"}, survey)).probes[:3]
    trial = max(
        (try_effects(base, [probe.effect], n_passes=15) for probe in probes), key=lambda trial: trial.fit.log_posterior
    )
    assert more_is_left_elsewhere(trial, trial.effects, NEEDED) is elsewhere
    here = repeatable_heat(trial, acts_at(trial, trial.effects), NEEDED)
    assert more_is_left_elsewhere(trial, trial.effects, NEEDED, here) is elsewhere


def test_a_free_form_that_cannot_be_fitted_is_no_rival(monkeypatch: pytest.MonkeyPatch) -> None:
    """One whose variances ran away took a sensor's offset of 13 K with it, 1,300 nats likelier than anything else."""
    base, trial = named(resonance)
    assert repeatable_heat(trial, {"a"}, NEEDED).log_bayes_factor > NEEDED

    def fails(*_: object, **__: object) -> Trial:
        raise PrecisionError("sample 651: variances differ by more than double precision holds")

    monkeypatch.setattr(form, "try_effects", fails)
    assert repeatable_heat(trial, {"a"}, NEEDED) == Repeatable()
    assert against_free_forms(base, trial, {"a"}, trial.effects, NEEDED, NEEDED) == (Repeatable(), None)


def test_a_single_node_has_no_elsewhere() -> None:
    _, trial = named(resonance)
    assert not more_is_left_elsewhere(trial, trial.effects, NEEDED)


def test_a_member_that_the_others_make_superfluous_is_dropped_from_its_set() -> None:
    base, single = named(heater)
    pair = try_effects(single, [*single.effects, ConstantHeatLoad({"node": "a"}, {"Q_W": 0.0})], n_passes=15)
    state = Search(pair, base, findings=[Finding(Judged(pair.effects, Evidence(50.0, 0.0), pair))])
    prune(state, NEEDED)
    (finding,) = state.findings
    assert (
        [effect.name for effect in finding.effects] == ["proportional_heater"] == [e.name for e in state.trial.effects]
    )
    worth = weigh(single, pair, 1).log_bayes_factor  # what the readings say for the load: that it is not there
    assert worth < NEEDED
    alone = weigh(base, single, 1).log_bayes_factor
    assert finding.judged.evidence.log_bayes_factor == pytest.approx(alone, abs=0.5)
