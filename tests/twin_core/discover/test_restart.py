"""Restart: what was found in one place is fitted from the other settings of its kind."""

from functools import cache

import pytest

from benchmarks.case import Case
from benchmarks.network_cases import network_case
from twin_core.calibrate.second_order import fit_network
from twin_core.discover.evidence import weigh
from twin_core.discover.judge import Finding, Judged, Search
from twin_core.discover.restart import restart
from twin_core.discover.trial import Trial, resettled, try_effects, try_on_trajectories
from twin_core.effects import REGISTRY
from twin_core.effects.base import ParameterSpec


@cache
def heated() -> tuple[Case, Trial]:
    """Return a small spacecraft whose heater nobody declared, seldom at its full power, and its declared model."""
    case = network_case("proportional_heater", 109040, n_orbits=5, dt_s=180.0)
    fit, calibration = fit_network(case.spec, [case.record])
    return case, Trial((), fit, calibration.max_step_s, (calibration.optimum,))


def found(power_W: float) -> Search:
    """Return a search that has found the heater, its power fitted from the given one."""
    case, base = heated()
    true = REGISTRY["proportional_heater"](case.where, {**case.parameters, "Q_W": power_W}, {"reach_K": 5.0})
    trial = try_on_trajectories(base, (true,))
    assert trial is not None
    trial = resettled(base, trial)
    return Search(trial, base, findings=[Finding(Judged(trial.effects, weigh(base, trial, 1), trial))], past=(base,))


def test_a_limit_that_is_never_reached_is_looked_for_below() -> None:
    """There the likelihood has no slope along it."""
    case, _ = heated()
    state = found(2.0 * case.parameters["Q_W"])
    caught = state.trial
    (stuck,) = caught.present_effects
    assert stuck.values["Q_W"] > 1.3 * case.parameters["Q_W"]
    before = state.findings[0].judged.evidence.log_bayes_factor
    restart(state)
    (heater,) = state.trial.present_effects
    for name, true in case.parameters.items():
        assert heater.values[name] == pytest.approx(true, rel=0.05), name
    assert state.trial.calibration().log_posterior > caught.calibration().log_posterior + 5.0
    finding = state.findings[0]
    assert finding.judged.trial is state.trial
    assert finding.effects == state.trial.effects
    gained = state.trial.log_evidence() - caught.log_evidence()
    assert finding.judged.evidence.log_bayes_factor == pytest.approx(before + gained)
    assert state.failures == []


def test_the_likeliest_fit_stays() -> None:
    case, _ = heated()
    state = found(case.parameters["Q_W"])
    before, findings = state.trial, list(state.findings)
    restart(state)
    assert state.trial is before
    assert state.findings == findings


def test_an_effect_with_one_setting_is_not_fitted_again(monkeypatch: pytest.MonkeyPatch) -> None:
    case, base = heated()
    load = REGISTRY["constant_heat_load"]({"node": case.spec.nodes[0].id}, {"Q_W": 1.0})
    trial = try_effects(base, (load,))
    state = Search(trial, base, findings=[Finding(Judged(trial.effects, weigh(base, trial, 1), trial))], past=(base,))
    monkeypatch.setattr("twin_core.discover.restart.try_on_trajectories", None)
    restart(state)
    assert state.trial is trial and state.failures == []


def test_a_form_of_more_parameters_is_none_of_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its parameters would have to be paid for, which completion and the search do."""
    case, _ = heated()
    state = found(2.0 * case.parameters["Q_W"])
    kind = type(state.trial.effects[0])

    class Richer(kind):  # type: ignore[misc, valid-type]
        def parameter_specs(self) -> tuple[ParameterSpec, ...]:
            return (*super().parameter_specs(), ParameterSpec("more", "1"))

    starts = kind.starts
    monkeypatch.setattr(
        kind,
        "starts",
        classmethod(lambda cls, where, survey: (Richer(e.where, e.values, e.settings) for e in starts(where, survey))),
    )
    before = state.trial
    restart(state)
    assert state.trial is before and state.failures == []


def test_nothing_found_is_nothing_to_restart() -> None:
    _, base = heated()
    state = Search(base, base)
    restart(state)
    assert state.trial is base and state.findings == []
