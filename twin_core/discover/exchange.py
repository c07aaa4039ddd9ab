"""Exchange: each effect against other names for it where it acts, once the others are known.

Effects are found one or two at a time, while others are still missing, and the one that bends furthest may take over a part of
what these do: a film whose exponent turns out to be one is a leak, a load whose knots are alike is constant. Sequential
replacement (Miller, Subset Selection in Regression, 2002, section 3.4) asks every effect again.
"""

from dataclasses import replace
from functools import partial

from twin_core.discover.evidence import weigh
from twin_core.discover.form import acts_at
from twin_core.discover.judge import OUTDONE, Finding, Judged, Search, examine, once_each, simplest_first
from twin_core.discover.revision import attempted_without
from twin_core.discover.screen import screen_sizes
from twin_core.discover.shortlist import UNDECLARED_SHARES, best_of_each_place, candidates, refined, shortlist
from twin_core.discover.trial import Trial, try_effects
from twin_core.effects.base import Effect

N_RIVALS = 4
"""Places of other names that are fitted for each effect, the best by linear screening: a limit of time. Of two cases with
two effects both had a wrong name without it, and none at 1, 2, 4 and 8, which took 83, 85, 89 and 102 s."""


def exchange(state: Search, needed: float) -> None:
    """Put simpler or likelier names in the place of effects that were found while others were missing."""
    for own in state.trial.effects:
        if len(state.trial.effects) > 1 and not own.fallback:
            state.attempt(partial(_exchanged, state, own, needed), f"other names for what {own.label} does")


def _exchanged(state: Search, own: Effect, needed: float) -> bool:
    """Put the simplest name that the readings hardly tell from the likeliest in an effect's place; return whether it did."""
    kept = attempted_without(state, {own.place})
    finding = next((f for f in state.findings if own.place in f.judged.places), None)
    if kept is None or finding is None:
        return False
    without, lost = kept
    others = tuple(effect for effect in state.trial.effects if effect.place != own.place)
    fitted = state.attempt_each(
        [
            (partial(try_effects, state.trial, (*others, rival), n_passes=10), f"{rival.label} instead of {own.label}")
            for rival in _rivals(without, own)
        ]
    )
    told = Judged((own,), replace(finding.judged.evidence, log_bayes_factor=lost), state.trial)
    options = [Judged(trial.effects[-1:], weigh(without, trial, 1), trial) for trial in fitted if trial is not None]
    best = simplest_first(once_each([told, *options]))[0]
    if best is told:
        return False
    examined, _ = examine(without, best, needed)
    if examined.reason:
        return False
    state.rejected = [j for j in state.rejected if j.effects != best.effects]
    state.rejected.append(replace(told, reason=OUTDONE))
    state.findings = [
        _renamed(f, own, examined, examined.evidence.log_bayes_factor - lost) if f is finding else f
        for f in state.findings
    ]
    state.trial = examined.trial
    return True


def _renamed(finding: Finding, own: Effect, examined: Judged, more: float) -> Finding:
    """Return a finding with another name for one of its effects, which is worth so much more than it."""
    if len(finding.effects) == 1:
        return Finding(examined)
    judged = finding.judged
    evidence = replace(judged.evidence, log_bayes_factor=judged.evidence.log_bayes_factor + more)
    effects = tuple(examined.effects[0] if effect.place == own.place else effect for effect in judged.effects)
    return Finding(replace(judged, effects=effects, evidence=evidence, trial=examined.trial))


def _rivals(without: Trial, own: Effect) -> list[Effect]:
    """Return the best other names for an effect, with no more parameters, that act where it does on top of a trial without it."""
    survey, effects = candidates(without, without.fit, fallback=False)
    here, most = acts_at(without, (own,)), own.n_free
    acting = {place: acts_at(without, (effect,)) for place, effect in {e.place: e for e in effects}.items()}
    effects = [
        effect
        for effect in effects
        if effect.place != own.place
        and effect.n_free <= most
        and (acting[effect.place] == here if here else effect.where == own.where)
    ]
    screenings = screen_sizes(without.fit, UNDECLARED_SHARES, survey, effects)
    rankings = [best_of_each_place(screening.probes, without.n_samples) for screening in screenings]
    return refined(without.fit, shortlist(rankings, 0.0, N_RIVALS))
