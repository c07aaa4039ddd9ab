"""Completion: what an effect that was found may also have, which its simplest form lacks, such as an end."""

from dataclasses import replace
from functools import partial

from twin_core.discover import policy
from twin_core.discover.evidence import validate, weigh
from twin_core.discover.judge import Judged, Search
from twin_core.discover.screen import screen_sizes, survey_of
from twin_core.discover.shortlist import UNDECLARED_SHARES
from twin_core.discover.trial import Trial, about_trajectory, resettled, try_on_trajectories
from twin_core.effects.base import Effect


def complete(state: Search, needed: float) -> None:
    """Give every effect of the last finding its fuller form where the readings support it, by the odds asked for."""
    for effect in state.findings[-1].effects if state.findings else ():
        fuller = state.attempt(partial(_fuller, state, effect, needed), f"{effect.label} in its fuller form")
        if fuller is not None:
            state.findings[-1] = replace(state.findings[-1], judged=fuller)
            state.trial = fuller.trial


def _fuller(state: Search, effect: Effect, needed: float) -> Judged | None:
    """Return the last finding with one of its effects in the best of its fuller forms; None if none is supported.

    Candidates are told by open-loop residuals: an event that nothing follows shows in long trajectories.
    """
    simple, finding = state.trial, state.findings[-1].judged
    present = {e.place: e for e in simple.present_effects}
    calibration = simple.calibration()
    about = about_trajectory(calibration.problem, calibration.optimum)
    survey = survey_of(about)
    forms = list(present[effect.place].completed(survey))
    if not forms:
        return None
    chosen = {
        id(p.effect): p.effect for s in screen_sizes(about, UNDECLARED_SHARES, survey, forms) for p in s.probes[:1]
    }
    best: Judged | None = None
    for form in chosen.values():
        trial = _with_form(simple, form)
        if trial is None:
            continue
        evidence = weigh(simple, trial, len(forms))
        if evidence.log_bayes_factor > max(needed, 0.0 if best is None else best.evidence.log_bayes_factor):
            best = Judged(trial.effects, evidence, trial)
    if best is None or not validate(simple, best.trial).foresight < policy.FORESIGHT:
        return None
    places = {e.place for e in finding.effects}
    both = replace(
        finding.evidence,
        log_bayes_factor=finding.evidence.log_bayes_factor + best.evidence.log_bayes_factor,
        p_value=min(finding.evidence.p_value, best.evidence.p_value),
    )
    return replace(
        finding, effects=tuple(e for e in best.trial.effects if e.place in places), evidence=both, trial=best.trial
    )


def _with_form(simple: Trial, form: Effect) -> Trial | None:
    """Return a trial with one effect in another form, fitted; None where the balance has no solution."""
    effects = tuple(form if e.place == form.place else e for e in simple.present_effects)
    trial = try_on_trajectories(simple, effects)
    return None if trial is None else resettled(simple, trial)
