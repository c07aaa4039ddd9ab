"""Exchange: an effect that was found while another was missing gets the name that it has once that is known."""

from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from benchmarks.case import Case
from benchmarks.network_cases import network_case
from twin_core.calibrate.second_order import fit_network
from twin_core.discover.evidence import weigh
from twin_core.discover.exchange import exchange
from twin_core.discover.judge import OUTDONE, Finding, Judged, Search, threshold
from twin_core.discover.screen import screen, survey_of
from twin_core.discover.trial import Trial, try_effects
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect

NEEDED = threshold(0.01)
BIAS_K = 1.5


@cache
def leaking() -> tuple[Case, Trial]:
    """Return a small spacecraft whose leak nobody declared, one sensor of which goes off by a step, and its declared model."""
    case = network_case("leak_to_boundary", 1, n_orbits=5, dt_s=180.0)
    sensor = case.spec.sensors[-1]
    late = case.record.time_s > 0.6 * case.record.time_s[-1]
    values = {**case.record.values, sensor: case.record.values[sensor] + BIAS_K * late}
    record = replace(case.record, values=values)
    fit, calibration = fit_network(case.spec, [record])
    return replace(case, record=record), Trial((), fit, calibration.max_step_s, (calibration.optimum,))


def best_start(name: str, where: Any) -> Effect:
    _, base = leaking()
    survey = survey_of(base.fit)
    return screen(base.fit, survey, list(REGISTRY[name].starts(where, survey))).probes[0].effect


def found(*names: str, together: bool) -> Search:
    """Return a search that has found effects at the leak under some names, and the sensor's step, at once or one by one."""
    case, base = leaking()
    onset_s = 0.6 * float(case.record.time_s[-1])
    step = best_start("sensor_bias", {"sensor": case.spec.sensors[-1]}).with_values({"b_K": BIAS_K, "time": onset_s})
    heats = [best_start(name, case.where) for name in names]
    trial = try_effects(base, (*heats, step), n_passes=12)
    sets = [trial.effects] if together else [(effect,) for effect in trial.effects]
    findings = [Finding(Judged(effects, weigh(base, trial, 1), trial)) for effects in sets]
    return Search(trial, base, findings=findings, past=(base,))


@pytest.mark.parametrize("together", [True, False])
def test_a_film_whose_exponent_is_one_is_a_leak(together: bool) -> None:
    state = found("nonlinear_convection", together=together)
    exchange(state, NEEDED)
    named = [effect.name for finding in state.findings for effect in finding.effects]
    assert named == ["leak_to_boundary", "sensor_bias"]
    assert sorted(effect.name for effect in state.trial.effects) == sorted(named)
    assert state.findings[0].judged.trial is state.trial
    assert [(j.effects[0].name, j.reason) for j in state.rejected] == [("nonlinear_convection", OUTDONE)]
    case, _ = leaking()
    leak = next(effect for effect in state.trial.present_effects if effect.name == "leak_to_boundary")
    assert leak.values["G_W_per_K"] == pytest.approx(case.parameters["G_W_per_K"], rel=0.2)


def test_a_right_name_stays() -> None:
    state = found("leak_to_boundary", together=True)
    before = state.trial
    exchange(state, NEEDED)
    assert state.trial is before
    assert state.rejected == []


def test_nothing_is_asked_of_a_single_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was compared with every other name where it was found."""
    case, base = leaking()
    trial = try_effects(base, (best_start("nonlinear_convection", case.where),))
    monkeypatch.setattr("twin_core.discover.exchange.try_effects", None)
    state = Search(trial, base, findings=[Finding(Judged(trial.effects, weigh(base, trial, 1), trial))])
    exchange(state, NEEDED)
    assert state.trial is trial and state.failures == []
