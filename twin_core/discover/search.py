"""The search: which effects, alone or together, the training record supports. It never sees a hold-out."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from twin_core._typing import Progress
from twin_core.discover.confirm import Evidence, Trial, Validation, try_effects, validate, weigh
from twin_core.discover.screen import Probe, Screening, joint_gain, screen, survey_of
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect

MAX_FINDINGS = 4
N_REFITS = 12
LATENT_SHARES = (1.0, 0.1, 0.01)
"""Sizes of the latent heat at which candidates are screened, as shares of the fitted one."""

N_PAIR_PROBES = 16
N_PAIR_REFITS = 5
N_SETTLED = 4
N_VALIDATED = 3
ALTERNATIVE_NATS = 3.0
VALIDATION_GAIN = 0.97
"""An effect must lower the error on blocks that it was not fitted to by 3 % at least, or it is not worth its name."""


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
    """The state of a search: the model so far and how it came about."""

    trial: Trial
    base: Trial
    findings: list[Finding] = field(default_factory=list)
    rejected: list[Judged] = field(default_factory=list)


def threshold(false_alarm_rate: float) -> float:
    """Return the log Bayes factor that an effect must reach: the odds of the false-alarm rate."""
    return float(np.log(1.0 / false_alarm_rate))


def screened(trial: Trial, *, fallback: bool) -> list[Screening]:
    """Screen every candidate effect at every place and setting that the trial does not have yet.

    Returns
    -------
    list of Screening
        One per assumed size of the latent heat: as fitted, where it explains everything a little, and smaller, as it
        would be if the right effect were in place.
    """
    survey = survey_of(trial.fit)
    taken = {effect.place for effect in trial.effects}
    effects = [
        effect
        for kind in REGISTRY.values()
        if kind.fallback == fallback
        for where in kind.places(survey.layout)
        for effect in kind.starts(where, survey)
        if effect.place not in taken
    ]
    latent = trial.fit.latent
    sized = [replace(trial.fit, latent=replace(latent, std_W=share * latent.std_W)) for share in LATENT_SHARES]
    return [screen(fit, survey, effects) for fit in sized]


def shortlist(rankings: Sequence[Sequence[Probe]], needed: float) -> list[Effect]:
    """Return the effects worth a refit: the best of every ranking in turn, each place once."""
    chosen: dict[object, Effect] = {}
    for rank in range(N_REFITS):
        for ranked in rankings:
            if rank < len(ranked) and ranked[rank].gain > needed and len(chosen) < N_REFITS:
                chosen.setdefault(ranked[rank].effect.place, ranked[rank].effect)
    return list(chosen.values())


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
    screenings = screened(state.trial, fallback=fallback)
    rankings = [best_of_each_place(screening.probes, state.trial.n_samples) for screening in screenings]
    n_tried = max(len(ranked) for ranked in rankings)
    singles = [(effect,) for effect in shortlist(rankings, needed)]
    if _accept(state, singles, n_tried, needed):
        return True
    pairs = [] if fallback else _best_pairs(rankings[0], screenings[0], needed)
    return _accept(state, pairs, max(n_tried**2 // 2, 1), needed)


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


def _accept(state: Search, options: Sequence[tuple[Effect, ...]], n_tried: int, needed: float) -> bool:
    """Refit every option, keep the best that passes evidence and validation; False if none does."""
    judged = [_judge(state, state.trial, option, n_tried, n_passes=3) for option in options]
    judged.sort(key=_worth)
    near = [j for j in judged[:N_SETTLED] if j.evidence.log_bayes_factor > judged[0].evidence.log_bayes_factor - 40.0]
    settled = [_judge(state, j.trial, j.effects, n_tried, n_passes=15) for j in near]
    judged = sorted([*settled, *judged[len(near) :]], key=_worth)
    for best in judged[:N_VALIDATED]:
        if best.evidence.log_bayes_factor <= needed:
            break
        validation = validate(state.trial, best.trial)
        if validation.ratio < VALIDATION_GAIN:
            close = [j for j in judged if j is not best and _is_close(j, best)]
            state.trial = best.trial
            own = Judged(best.effects, best.evidence, best.trial, validation)
            state.findings.append(Finding(own, tuple(close)))
            return True
        state.rejected.append(Judged(best.effects, best.evidence, best.trial, validation))
    state.rejected += [j for j in judged if j.evidence.log_bayes_factor <= needed]
    return False


def _judge(state: Search, start: Trial, option: tuple[Effect, ...], n_tried: int, *, n_passes: int) -> Judged:
    """Fit an option on top of the state's effects, started from a trial close by."""
    trial = try_effects(start, (*state.trial.effects, *option), n_passes=n_passes)
    found = trial.effects[len(state.trial.effects) :]
    return Judged(found, weigh(state.trial, trial, n_tried), trial)


def _worth(judged: Judged) -> float:
    return -judged.evidence.log_bayes_factor


def _is_close(other: Judged, best: Judged) -> bool:
    """Return whether the data hardly tell another option from the best one."""
    return other.evidence.log_bayes_factor > best.evidence.log_bayes_factor - ALTERNATIVE_NATS


def _prune(state: Search, needed: float) -> None:
    """Drop findings that a later one has made superfluous."""
    for finding in list(state.findings[:-1]):
        kept = [f for f in state.findings if f is not finding]
        without = try_effects(state.trial, [e for f in kept for e in _present(state, f)])
        if weigh(without, state.trial, 1).log_bayes_factor <= needed:
            state.trial, state.findings = without, kept


def _present(state: Search, finding: Finding) -> list[Effect]:
    """Return a finding's effects at their present values."""
    places = {effect.place for effect in finding.effects}
    return [effect for effect in state.trial.effects if effect.place in places]
