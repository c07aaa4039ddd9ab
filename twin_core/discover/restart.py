"""Restart: what was found, fitted from the other settings that its kind starts from.

A local search is caught where a slope vanishes: at a power limit that is never reached, or at set-points between which a heater
switches as often as it did at the start.
"""

from dataclasses import replace
from functools import partial

from twin_core.calibrate.undeclared.fit import SETTLED_NATS
from twin_core.discover.judge import Search
from twin_core.discover.revision import attempted_without
from twin_core.discover.screen import screen, survey_of
from twin_core.discover.shortlist import each_start
from twin_core.discover.trial import Trial, about_trajectory, bare, resettled, try_on_trajectories
from twin_core.effects.base import Effect

N_STARTS, LEAST_GAIN_SHARE = 4, 0.5
"""Settings from which an effect is fitted again, the best by linear screening, and their least gain as a share of the best
one's: a limit of time. Of thirteen findings two were caught, 27 and 212 nats below what the second and the first of these led to;
none of the settings of a smaller share led to likelier trajectories."""


def restart(state: Search) -> None:
    """Fit every effect of the last finding from other settings too; the likeliest trajectories count."""
    for effect in state.findings[-1].effects if state.findings else ():
        trial = state.attempt(partial(_restarted, state, effect), f"{effect.label} from other settings")
        if trial is not None:
            _go_on_from(state, trial)


def _restarted(state: Search, own: Effect) -> Trial | None:
    """Return the state's trial with an effect fitted from other settings; None where no trajectories are likelier."""
    kept = attempted_without(state, {own.place})
    if kept is None:
        return None
    without, found = kept[0], state.trial.calibration()
    start = bare(without, found)
    about = about_trajectory(start.problem, start.optimum, found)
    survey = survey_of(about)
    most = own.n_free  # of more parameters each would have to be paid for
    starts = type(own).starts(own.where, survey)
    forms = [form for e in starts for form in (e.simplified(survey) if own.held else (e,))]
    settings = [form for form in forms if form.n_free <= most]
    probes = screen(about, survey, settings).probes if len(settings) > 1 else ()
    likely = each_start([p.effect for p in probes if p.gain >= LEAST_GAIN_SHARE * probes[0].gain])[:N_STARTS]

    def fitted(effect: Effect) -> Trial | None:
        effects = tuple(effect if e.place == own.place else e for e in state.trial.present_effects)
        return try_on_trajectories(without, effects, start)

    tried = state.attempt_each([(partial(fitted, effect), f"{effect.label} from another setting") for effect in likely])
    best = max(filter(None, tried), key=lambda trial: trial.calibration().log_posterior, default=None)
    if best is None or best.calibration().log_posterior <= found.log_posterior + SETTLED_NATS:
        return None
    settled = resettled(without, best)
    return settled if settled.log_evidence() > state.trial.log_evidence() else None


def _go_on_from(state: Search, trial: Trial) -> None:
    """Take a likelier fit of what was found; the finding gains what it is likelier by."""
    finding = state.findings[-1]
    more = trial.log_evidence() - state.trial.log_evidence()
    evidence = replace(finding.judged.evidence, log_bayes_factor=finding.judged.evidence.log_bayes_factor + more)
    places = finding.judged.places
    effects = tuple(effect for effect in trial.effects if effect.place in places)
    state.findings[-1] = replace(
        finding, judged=replace(finding.judged, effects=effects, evidence=evidence, trial=trial)
    )
    state.trial = trial
