"""The search: which effects, alone or together, the training record supports. It never sees a hold-out."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from twin_core._typing import Progress
from twin_core.calibrate.latent_heat import HeatFit
from twin_core.discover.confirm import (
    Evidence,
    Trial,
    Validation,
    about_trajectory,
    resettled,
    try_effects,
    try_on_trajectories,
    validate,
    weigh,
    weigh_trajectories,
)
from twin_core.discover.screen import Probe, Screening, joint_gain, screen, survey_of
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect, Survey

MAX_FINDINGS = 4
N_REFITS = 12
N_TRAJECTORY_REFITS = 6
TRAJECTORY_SHARES = (1.0, 0.1, 0.01)
LATENT_SHARES = (1.0, 0.1, 0.01)
"""Sizes of the latent heat at which candidates are screened, as shares of the fitted one."""

N_PAIR_PROBES = 16
N_PAIR_REFITS = 5
N_SETTLED = 4
SETTLING_NATS = 40.0
"""Options this far behind after a few passes are not fitted further."""

N_VALIDATED = 3
ALTERNATIVE_NATS = 3.0
VALIDATION_GAIN = 0.97
"""An effect must lower the error on blocks that it was not fitted to by 3 % at least, or it is not worth its name."""

FORWARD_LIMIT = 1.02
"""Nor may it make the end of the training record worse when it is fitted to the beginning alone."""

DECISIVE, TOLERATED = 0.7, 1.7
"""Where one event tells all, either measure may see little of it: an effect that lowers the one by 30 % may raise the
other by as much as an event that it has not seen costs."""

LUMPING_SHARE = 0.005
"""What an effect changes must exceed this share of the temperatures' spread: below it a lumped network is no judge."""


EXPLAINED_SHARE = 0.5
"""An effect must make half of the latent heat's variance superfluous where it acts, or something else is missing there."""


@dataclass(frozen=True)
class Judged:
    """A set of effects that was tried on top of a simpler model, and what speaks for it."""

    effects: tuple[Effect, ...]
    evidence: Evidence
    trial: Trial
    validation: Validation | None = None


@dataclass(frozen=True)
class Finding:
    """Effects that the record supports together, and what it cannot tell them from."""

    judged: Judged
    alternatives: tuple[Judged, ...] = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects, at the values of the trial that found them."""
        return self.judged.effects


@dataclass
class Search:
    """The state of a search: the model so far and how it came about; ``n_named`` candidates were tried before a fallback."""

    trial: Trial
    base: Trial
    n_named: int = 0
    findings: list[Finding] = field(default_factory=list)
    rejected: list[Judged] = field(default_factory=list)


def threshold(false_alarm_rate: float) -> float:
    """Return the log Bayes factor that an effect must reach: the odds of the false-alarm rate."""
    return float(np.log(1.0 / false_alarm_rate))


def candidates(trial: Trial, fit: HeatFit, *, fallback: bool) -> tuple[Survey, list[Effect]]:
    """Return the points of a fit, and every candidate effect at every place and setting that the trial lacks."""
    survey = survey_of(fit)
    taken = {effect.place for effect in trial.effects}
    effects = [
        effect
        for kind in REGISTRY.values()
        if kind.fallback == fallback
        for where in kind.places(survey.layout)
        for effect in kind.starts(where, survey)
        if effect.place not in taken
    ]
    return survey, effects


def screened(trial: Trial, fit: HeatFit, shares: Sequence[float], *, fallback: bool) -> list[Screening]:
    """Screen the candidates of a trial about a fit, once per assumed size of the latent heat.

    As fitted, the latent heat explains everything a little; smaller, it is as it would be with the right effect in place.
    """
    survey, effects = candidates(trial, fit, fallback=fallback)
    sized = [replace(fit, latent=replace(fit.latent, std_W=share * fit.latent.std_W)) for share in shares]
    return [screen(one, survey, effects) for one in sized]


def shortlist(rankings: Sequence[Sequence[Probe]], needed: float, n_wanted: int) -> list[Effect]:
    """Return the effects worth a refit: the best of every ranking in turn, each place once."""
    chosen: dict[object, Effect] = {}
    for rank in range(n_wanted):
        for ranked in rankings:
            if rank < len(ranked) and ranked[rank].gain > needed and len(chosen) < n_wanted:
                chosen.setdefault(ranked[rank].effect.place, ranked[rank].effect)
    return list(chosen.values())


def refined(fit: HeatFit, effects: Sequence[Effect]) -> list[Effect]:
    """Return effects at the best of their finer settings, where the first ones are too coarse for a local search."""
    survey = survey_of(fit)
    finer = [setting for effect in effects for setting in effect.refined(survey)]
    best = {probe.effect.place: probe.effect for probe in reversed(screen(fit, survey, finer).probes)}
    return [best.get(effect.place, effect) for effect in effects]


def best_of_each_place(probes: Sequence[Probe], n_samples: int) -> list[Probe]:
    """Return the best setting of each effect and place, best first, each amplitude paid for by its Schwarz penalty."""
    penalty = 0.5 * np.log(max(n_samples, 2))
    best: dict[object, tuple[float, Probe]] = {}
    for probe in probes:
        worth = probe.gain - penalty * len(probe.effect.amplitudes)
        if probe.effect.place not in best or worth > best[probe.effect.place][0]:
            best[probe.effect.place] = (worth, probe)
    return [probe for _, probe in sorted(best.values(), key=lambda item: -item[0])]


def search(base: Trial, *, false_alarm_rate: float, progress: Progress) -> Search:
    """Find the effects that a declared model lacks.

    Parameters
    ----------
    base
        The declared model on the training record.
    false_alarm_rate
        Odds at which a finding on a healthy record is tolerated.
    progress
        Called with the fraction done.

    Returns
    -------
    Search
        With the findings in the order in which they were made.
    """
    state = Search(base, base)
    needed = threshold(false_alarm_rate)
    for step in range(MAX_FINDINGS):
        progress(step / MAX_FINDINGS, f"looking for effect {step + 1}")
        if not _extend(state, needed, fallback=False):
            break
        _prune(state, needed)
    if not state.findings:
        progress(0.9, "looking for a repeatable heat flow")
        _extend(state, needed, fallback=True)
    return state


def _extend(state: Search, needed: float, *, fallback: bool) -> bool:
    """Add the best supported effect, or pair of effects, to the state; False if none is supported."""
    if _extend_by_heat(state, needed, fallback=fallback):
        return True
    return _extend_by_trajectory(state, needed, fallback=fallback)


def _extend_by_heat(state: Search, needed: float, *, fallback: bool) -> bool:
    """Extend by what the innovations say, in the presence of latent heat."""
    screenings = screened(state.trial, state.trial.fit, LATENT_SHARES, fallback=fallback)
    rankings = [best_of_each_place(screening.probes, state.trial.n_samples) for screening in screenings]
    n_tried = _n_tried(state, rankings, fallback=fallback)
    singles = [(effect,) for effect in refined(state.trial.fit, shortlist(rankings, needed, N_REFITS))]
    if _accept(state, _by_heat(state, singles, n_tried), needed):
        return True
    pairs = [] if fallback else _best_pairs(rankings[0], screenings[0], needed)
    return _accept(state, _by_heat(state, pairs, max(n_tried**2 // 2, 1)), needed)


def _extend_by_trajectory(state: Search, needed: float, *, fallback: bool) -> bool:
    """Extend by what open-loop residuals say: the second look, where misfit is too large for the first.

    Long trajectories forgive an effect that merely resembles what is missing, so the innovations must support it too:
    once, for one effect, not for one among many.
    """
    calibration = state.trial.calibration
    fit = about_trajectory(calibration.problem, calibration.optimum)
    screenings = screened(state.trial, fit, TRAJECTORY_SHARES, fallback=fallback)
    rankings = [best_of_each_place(screening.probes, state.trial.n_samples) for screening in screenings]
    n_tried = _n_tried(state, rankings, fallback=fallback)
    judged = []
    for effect in refined(fit, shortlist(rankings, needed, N_TRAJECTORY_REFITS)):
        trial = try_on_trajectories(state.trial, (*state.trial.present_effects, effect))
        if trial is not None:
            found = trial.effects[len(state.trial.effects) :]
            judged.append(Judged(found, weigh_trajectories(state.trial, trial, n_tried), trial))
    likely = [j for j in judged if j.evidence.log_bayes_factor > needed]
    settled = [replace(j, trial=resettled(state.trial, j.trial)) for j in sorted(likely, key=_worth)[:N_VALIDATED]]
    supported = [j for j in settled if weigh(state.trial, j.trial, 1).log_bayes_factor > needed]
    state.rejected += [j for j in judged if all(j.effects != s.effects for s in supported)]
    return _accept(state, supported, needed)


def _n_tried(state: Search, rankings: Sequence[Sequence[Probe]], *, fallback: bool) -> int:
    """Return how many effects and places were looked at: a fallback comes after all the named ones."""
    n_own = max(len(ranked) for ranked in rankings)
    if fallback:
        return state.n_named + n_own
    state.n_named = n_own
    return n_own


def _best_pairs(ranked: Sequence[Probe], screening: Screening, needed: float) -> list[tuple[Effect, ...]]:
    """Return the pairs of probes that could add most together: more than either alone, and enough to be supported."""
    some = ranked[:N_PAIR_PROBES]
    scored = []
    for i, a in enumerate(some):
        for b in some[i + 1 :]:
            gain = joint_gain(a, b, screening.residual)
            if gain > max(a.gain, b.gain) + needed:
                scored.append((gain, (a.effect, b.effect)))
    scored.sort(key=lambda item: -item[0])
    return [pair for _, pair in scored[:N_PAIR_REFITS]]


def _by_heat(state: Search, options: Sequence[tuple[Effect, ...]], n_tried: int) -> list[Judged]:
    """Fit every option in the presence of latent heat: all in a few passes, the best ones until they settle."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # compiled loops and linear algebra run side by side
        quick = pool.map(lambda option: _judge(state, state.trial, option, n_tried, n_passes=3), options)
        judged = sorted(quick, key=_worth)
        best = judged[0].evidence.log_bayes_factor if judged else 0.0
        near = [j for j in judged[:N_SETTLED] if j.evidence.log_bayes_factor > best - SETTLING_NATS]
        settled = pool.map(lambda j: _judge(state, j.trial, j.effects, n_tried, n_passes=15), near)
        return [*settled, *judged[len(near) :]]


def _judge(state: Search, start: Trial, option: tuple[Effect, ...], n_tried: int, *, n_passes: int) -> Judged:
    """Fit an option on top of the state's effects, started from a trial close by."""
    trial = replace(try_effects(start, (*state.trial.effects, *option), n_passes=n_passes), simpler=state.trial)
    found = trial.effects[len(state.trial.effects) :]
    return Judged(found, weigh(state.trial, trial, n_tried), trial)


def _accept(state: Search, options: Sequence[Judged], needed: float) -> bool:
    """Keep the best option that passes evidence and validation; False if none does."""
    judged = simplest_first(once_each(options))
    failed: list[Judged] = []
    for best in judged[:N_VALIDATED]:
        if best.evidence.log_bayes_factor <= needed:
            continue
        own = replace(best, validation=validate(state.trial, best.trial))
        if own.validation is not None and is_valid(own.validation):
            close = [j for j in judged if j is not best and j not in failed and _is_close(j, best)]
            state.trial = best.trial
            state.findings.append(Finding(own, tuple(close)))
            return True
        failed.append(best)
        state.rejected.append(own)
    state.rejected += [j for j in judged if j.evidence.log_bayes_factor <= needed]
    return False


def once_each(options: Sequence[Judged]) -> list[Judged]:
    """Return the options, best first, every set of effects and places once."""
    best: dict[frozenset[object], Judged] = {}
    for judged in sorted(options, key=_worth):
        best.setdefault(frozenset(effect.place for effect in judged.effects), judged)
    return list(best.values())


def simplest_first(judged: Sequence[Judged]) -> list[Judged]:
    """Return options, best first, with the simplest of those in front that the data hardly tell from the best."""
    close = [j for j in judged if j is judged[0] or _is_close(j, judged[0])]
    rest = [j for j in judged if all(j is not c for c in close)]
    return sorted(close, key=lambda j: j.trial.fit.problem.n_free) + rest


def is_valid(validation: Validation) -> bool:
    """Return whether an effect helps where it was not fitted, by an amount that a lumped network can judge."""
    blocks, forward = validation.ratio, validation.forward_ratio
    both = blocks < VALIDATION_GAIN and forward < FORWARD_LIMIT
    either = min(blocks, forward) < DECISIVE and max(blocks, forward) < TOLERATED
    matters = validation.removed_share > LUMPING_SHARE and validation.explained_share > EXPLAINED_SHARE
    return (both or either) and matters


def _worth(judged: Judged) -> float:
    return -judged.evidence.log_bayes_factor


def _is_close(other: Judged, best: Judged) -> bool:
    """Return whether the data hardly tell another option from the best one."""
    return other.evidence.log_bayes_factor > best.evidence.log_bayes_factor - ALTERNATIVE_NATS


def _prune(state: Search, needed: float) -> None:
    """Drop findings that a later one has made superfluous."""
    for finding in list(state.findings[:-1]):
        kept = [f for f in state.findings if f is not finding]
        without = try_effects(state.trial, [e for f in kept for e in _present(state, f)], n_passes=10)
        if weigh(without, state.trial, 1).log_bayes_factor <= needed:
            state.trial, state.findings = without, kept


def _present(state: Search, finding: Finding) -> list[Effect]:
    """Return a finding's effects at their present values."""
    places = {effect.place for effect in finding.effects}
    return [effect for effect in state.trial.effects if effect.place in places]
