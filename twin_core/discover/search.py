"""The search: which effects, alone or together, the training record supports. It never sees a hold-out."""

import os
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np

from twin_core._typing import Progress, no_progress
from twin_core.calibrate.containment import NO_DEADLINE
from twin_core.calibrate.undeclared.model import gain_of_undeclared_heat
from twin_core.discover import policy
from twin_core.discover.alternatives import add_coarse_alternatives
from twin_core.discover.coarseness import by_chance, least_explained, stands
from twin_core.discover.complete import complete
from twin_core.discover.confirm import Trial, mean_excess, resettled, try_effects, weigh
from twin_core.discover.judge import (
    LESS_LIKELY,
    NO_FORESIGHT,
    NO_LAW,
    NO_MORE,
    OUTDONE,
    SMALL_REMAINDER,
    Finding,
    Judged,
    Search,
    accept,
    examine,
    foresight_of,
    once_each,
    threshold,
    worth,
)
from twin_core.discover.screen import Probe, joint_gain, projected_responses, survey_of
from twin_core.discover.shortlist import UNDECLARED_SHARES, best_of_each_place, refined, screened, shortlist
from twin_core.discover.trajectories import extend_by_trajectory
from twin_core.effects.base import Effect, Place, touched_nodes

MAX_FINDINGS = 4
N_REFITS = 12
N_FREE_PLACES = 2
"""Places at the head of each ranking at which a heat without a name is tried in all its forms."""

N_PAIR_PROBES = 16
N_PAIR_REFITS = 5
N_SETTLED = 3
SETTLING_NATS = 40.0
"""Options this far behind after a few passes are not fitted further."""

RIVAL_NATS = 20.0
"""Forms this near the best one at its place are compared once more."""

N_EXCHANGED = 2
"""Refused options that are tried in the place of a finding."""

N_FORMS = 4
"""Other forms where the best option acts that are fitted further."""

N_FIRST = 2
"""Options that screening puts first are always fitted further: a few passes tell more of the undeclared heat's size."""


def search(
    base: Trial,
    *,
    false_alarm_rate: float,
    deadline: float = NO_DEADLINE,
    first: Collection[Place] = (),
    progress: Progress = no_progress,
) -> Search:
    """Find the effects that a declared model lacks.

    Parameters
    ----------
    base
        The declared model on the training record.
    false_alarm_rate
        Odds at which a finding on a healthy record is tolerated.
    deadline
        On the clock of ``time.monotonic``: what is not fitted by then is left out, and told.
    first
        Places of effects that spacecraft of the same design have.
    progress
        Called with the fraction done.

    Returns
    -------
    Search
        With the findings in the order in which they were made.
    """
    state = Search(base, base, deadline=deadline, first=first)
    needed = threshold(false_alarm_rate)
    for step in range(MAX_FINDINGS):
        progress(step / MAX_FINDINGS, f"looking for effect {step + 1}")
        before = state.fork()
        extended = _extend(state, needed, fallback=False)
        refused, before.rejected = state.rejected[len(before.rejected) :], list(state.rejected)
        if exchange(before, refused, needed):
            state.join(before)
        elif not extended:
            break
        complete(state, needed)
        prune(state, needed)
    withdraw(state, needed)
    if not state.findings:
        progress(0.9, "looking for a repeatable heat flow")
        _extend(state, needed, fallback=True)
        withdraw(state, needed)
    reconsider(state, needed)
    progress(0.95, "comparing what was found with other names")
    tell_alternatives(state, needed)
    return state


def reconsider(state: Search, needed: float) -> None:
    """Name an option that was refused for the heat that it leaves, if what was found instead is no better.

    What it leaves is little, and nothing or a heat without a name was found; or it leaves much, and a name was found that
    leaves no such heat and yet is less likely and predicts worse: whichever law holds there, that one does not.
    """
    if len(state.findings) > 1:
        return
    is_named = any(not effect.fallback for finding in state.findings for effect in finding.effects)
    reasons = (SMALL_REMAINDER, NO_LAW) if is_named else (SMALL_REMAINDER,)
    near = [j for j in state.rejected if j.reason in reasons and len(j.trial.effects) == len(j.effects)]
    if is_named:
        near = [
            j for j in near if all(worth(j) < worth(f.judged) and foresight_of(j) < f.foresight for f in state.findings)
        ]
    if not near:
        return
    best = min(near, key=worth)
    rest = [j for j in state.rejected if j.effects != best.effects]
    named = replace(state, trial=best.trial, findings=[Finding(replace(best, reason=""))], rejected=rest)
    withdraw(named, needed)
    if named.findings and all(_is_better(named.findings[0], other) for other in state.findings):
        if is_named:
            named.rejected += [replace(f.judged, reason=OUTDONE) for f in state.findings]
        state.join(named)


def tell_alternatives(state: Search, needed: float) -> None:
    """Tell beside each finding the names that a coarse network cannot tell from it; they count as refused no more."""
    for i, finding in enumerate(state.findings):
        kept = _attempted_without(state, {effect.place for effect in finding.effects})
        if kept is None:
            continue
        compared = state.attempt(
            partial(add_coarse_alternatives, state, kept[0], finding, needed),
            f"alternatives to {finding.judged.labels}",
        )
        if compared is not None:
            state.findings[i] = compared
            told = {e.place for option in compared.alternatives for e in option.effects}
            state.rejected = [j for j in state.rejected if not (len(j.effects) == 1 and j.effects[0].place in told)]


def _is_better(name: Finding, heat: Finding) -> bool:
    """Return whether a name predicts better than what was found, or is likelier where chance tells them apart no further."""
    if heat.foresight * policy.FORESIGHT <= name.foresight <= heat.foresight / policy.FORESIGHT:
        return worth(name.judged) < worth(heat.judged)
    return name.foresight < heat.foresight


def _extend(state: Search, needed: float, *, fallback: bool) -> bool:
    """Add the best supported effect, or pair of effects, to the state; False if none is supported or nothing is missing."""
    if state.attempt(lambda: bool(state.trial.excess().max() < policy.LEAST_EXCESS), "how well trajectories fit"):
        return False
    missing = state.attempt(partial(gain_of_undeclared_heat, state.trial.fit), "how much heat is missing")
    if missing is not None and missing <= needed:
        return False
    what = "effects without a name" if fallback else f"effect {len(state.findings) + 1}"
    widened = not state.findings or mean_excess(state.trial) > policy.WIDENED
    by_heat, by_trajectory = state.fork(), state.fork()
    first = partial(_extend_by_heat, by_heat, needed, fallback=fallback, pairs=widened)
    told = state.attempt(first, f"{what}, by what the filter leaves")
    after = by_heat.trial
    if not widened or (told and mean_excess(after) <= policy.MOST_COARSENESS and stands(state.trial, after)):
        state.join(by_heat)
        return bool(told)
    beside = [] if told or fallback else _unseen_by_trajectories(by_heat.rejected[len(state.rejected) :])
    second = partial(extend_by_trajectory, by_trajectory, needed, fallback=fallback, beside=beside)
    seen = state.attempt(second, f"{what}, by open-loop residuals")
    options = [fork for fork, found in ((by_heat, told), (by_trajectory, seen)) if found]
    refused = [*by_trajectory.rejected, *by_heat.rejected[len(state.rejected) :]]
    if not options:
        state.rejected = refused
        return False
    state.join(min(options, key=lambda fork: fork.findings[-1].foresight))
    named = {effect.place for effect in state.findings[-1].effects}
    state.rejected = [j for j in refused if {effect.place for effect in j.effects} != named]
    return True


def _unseen_by_trajectories(refused: Sequence[Judged]) -> list[Trial]:
    """Return the likeliest single effect that was refused for what it does to trajectories, if any.

    A lagging sensor, say, shows between neighbouring readings and changes no long trajectory; what does may show beside it only.
    """
    singles = [j for j in refused if j.reason in (NO_FORESIGHT, LESS_LIKELY) and len(j.effects) == 1]
    return [min(singles, key=worth).trial] if singles else []


def _extend_by_heat(state: Search, needed: float, *, fallback: bool, pairs: bool) -> bool:
    """Extend by what the innovations say beside undeclared heat; by ``pairs`` where no single effect is supported."""
    screenings = screened(state.trial, state.trial.fit, UNDECLARED_SHARES, fallback=fallback)
    rankings = [best_of_each_place(screening.probes, state.trial.n_samples) for screening in screenings]
    n_tried = state.count(max(len(ranked) for ranked in rankings), fallback=fallback)
    if fallback:
        some = {probe.effect.place for ranked in rankings for probe in ranked[:N_FREE_PLACES] if probe.gain > needed}
        chosen = [probe.effect for probe in screenings[0].probes if probe.effect.place in some]  # of every degree
    else:
        chosen = refined(state.trial.fit, shortlist(rankings, needed, N_REFITS, state.first))
    singles = [(effect,) for effect in chosen]
    if accept(state, _by_heat(state, singles, n_tried), needed):
        return True
    both = _best_pairs(rankings[0], state.trial, needed) if pairs and not fallback else []
    return accept(state, _by_heat(state, both, max(n_tried**2 // 2, 1)), needed)


def _best_pairs(ranked: Sequence[Probe], trial: Trial, needed: float) -> list[tuple[Effect, ...]]:
    """Return the pairs of probes that could add most together: more than either alone, and enough to be supported."""
    some = ranked[:N_PAIR_PROBES]
    responses, residual = projected_responses(trial.fit, survey_of(trial.fit), [probe.start for probe in some])
    scored = []
    for (a, of_a), (b, of_b) in combinations(zip(some, responses, strict=True), 2):
        gain = joint_gain(of_a, of_b, residual)
        if gain > max(a.gain, b.gain) + needed:
            scored.append((gain, (a.effect, b.effect)))
    scored.sort(key=lambda item: -item[0])
    return [pair for _, pair in scored[:N_PAIR_REFITS]]


def _by_heat(state: Search, options: Sequence[tuple[Effect, ...]], n_tried: int) -> list[Judged]:
    """Fit every option in the presence of undeclared heat: all in a few passes, the best ones until they settle."""

    def fitted(start: Trial, option: tuple[Effect, ...], n_passes: int, *, quick: bool = False) -> Judged | None:
        work = partial(_judge, state, start, option, n_tried, n_passes=n_passes, quick=quick)
        return state.attempt(work, " with ".join(effect.label for effect in option))

    with ThreadPoolExecutor(os.cpu_count()) as pool:  # compiled loops and linear algebra run side by side
        quick = _done(pool.map(lambda option: fitted(state.trial, option, 3, quick=True), options))
        judged = sorted(quick, key=worth)
        best = judged[0].evidence.log_bayes_factor if judged else 0.0
        near = [j for j in judged[:N_SETTLED] if j.evidence.log_bayes_factor > best - SETTLING_NATS]
        here = _acts_at(judged[0]) if judged else set()
        likely = [j for j in judged if j.evidence.log_bayes_factor > best - SETTLING_NATS]
        rivals = [*quick[:N_FIRST], *[j for j in likely if _acts_at(j) == here][:N_FORMS]]
        near += [j for i, j in enumerate(rivals) if all(j is not n for n in [*near, *rivals[:i]])]
        settled = _done(pool.map(lambda j: fitted(j.trial, j.effects, 12), near))
        rest = [j for j in judged if all(j is not n for n in near)]
        forms = _forms_of_the_best(settled)
        compared = _done(
            pool.map(lambda j: state.attempt(partial(_from_trajectories, state, j, n_tried), j.labels), forms)
        )
        return once_each([*settled, *compared, *rest])


def _done(options: Iterable[Judged | None]) -> list[Judged]:
    """Return what was fitted, and is likely at all."""
    return [j for j in options if j is not None and np.isfinite(j.evidence.log_bayes_factor)]


def _forms_of_the_best(settled: Sequence[Judged]) -> list[Judged]:
    """Return the best option with its rivals: no less simple, acting where it does, and near it; none if it has no rival.

    These explain the same heat, so a fit that stopped early must not decide between them.
    """
    if not settled:
        return []
    best = min(settled, key=worth)
    near = [j for j in settled if j.evidence.log_bayes_factor > best.evidence.log_bayes_factor - RIVAL_NATS]
    simple = [j for j in near if j.trial.fit.problem.n_free <= best.trial.fit.problem.n_free]
    rivals = [j for j in simple if _acts_at(j) == _acts_at(best)]
    return rivals if len({j.trial.effects[-1].place for j in rivals}) > 1 else []


def _from_trajectories(state: Search, judged: Judged, n_tried: int) -> Judged:
    """Return an option fitted from its open-loop optimum too, at the likelier of both fits."""
    trial = resettled(state.trial, judged.trial)
    return Judged(trial.effects[len(state.trial.effects) :], weigh(state.trial, trial, n_tried), trial)


def _acts_at(judged: Judged) -> set[str]:
    """Return the nodes at which the effects of an option act."""
    layout = judged.trial.fit.network.layout
    return {node for effect in judged.effects for node in touched_nodes(effect, layout)}


def _judge(
    state: Search, start: Trial, option: tuple[Effect, ...], n_tried: int, *, n_passes: int, quick: bool = False
) -> Judged:
    """Fit an option on top of the state's effects, started from a trial close by."""
    trial = replace(
        try_effects(start, (*state.trial.effects, *option), n_passes=n_passes, quick=quick), simpler=state.trial
    )
    found = trial.effects[len(state.trial.effects) :]
    return Judged(found, weigh(state.trial, trial, n_tried, quick=quick), trial)


def withdraw(state: Search, needed: float) -> None:
    """Withdraw what explains no more than a lumped network may leave: both may be its coarseness.

    A finding must explain more than what stays beside it, and each of its effects more than any coarse network may have left.
    Where the model fits to the noise nothing stays, and every finding stands. The weakest goes first: what it explained then
    counts as unexplained, unless the others explain it too; what is left of a set that lost a member is examined as any option.
    """
    while state.findings:
        left, n_readings = mean_excess(state.trial), state.trial.n_samples
        if left <= by_chance(n_readings):
            return
        asked: dict[frozenset[object], float] = {}
        for finding in state.findings:
            places = frozenset(effect.place for effect in finding.effects)
            is_named = not all(effect.fallback for effect in finding.effects)
            asked |= {frozenset([place]): least_explained(0.0, left, n_readings) for place in places}
            asked[places] = least_explained(left, left, n_readings) if is_named else policy.DOMINANCE * left
        without = {places: _attempted_without(state, places) for places in asked}
        told = {
            places: (mean_excess(kept[0]) - left) / asked[places] if asked[places] > 0.0 else np.inf
            for places, kept in without.items()
            if kept
        }
        weakest = min(told, key=lambda places: told[places], default=None)
        if weakest is None or told[weakest] >= 1.0:
            return
        for finding in state.findings:
            effects = tuple(effect for effect in finding.effects if effect.place in weakest)
            if effects:
                state.rejected.append(replace(finding.judged, effects=effects, reason=NO_MORE))
        kept = without[weakest]
        assert kept is not None
        shrunk = [f for f in state.findings if any(e.place in weakest for e in f.effects)]
        rests = [{e.place for e in f.effects} - weakest for f in shrunk]
        _drop(state, weakest, *kept)
        for rest in filter(None, rests):
            _examine_again(state, rest, needed)


def _examine_again(state: Search, places: Collection[object], needed: float) -> None:
    """Withdraw the finding at places if by itself it does not pass what any option must; little that it leaves was explained."""
    without = _attempted_without(state, places)
    finding = next(f for f in state.findings if {effect.place for effect in f.effects} == places)
    if without is None:
        return
    option = replace(finding.judged, trial=state.trial)
    examined = state.attempt(partial(examine, without[0], option, needed), option.labels)
    if examined is None:
        return
    if examined[0].reason in ("", SMALL_REMAINDER):
        again = replace(finding, judged=replace(finding.judged, validation=examined[0].validation))
        state.findings = [again if f is finding else f for f in state.findings]
        return
    state.rejected.append(examined[0])
    _drop(state, places, *without)


def exchange(state: Search, refused: Sequence[Judged], needed: float) -> bool:
    """Put an effect that was refused beside a finding in its place, if both act there and it explains more; False if none does.

    The first look may take a part of what is missing for the whole: a heater that came on once for a load with an onset. What
    switches it off again is then tried beside it, where it does not belong.
    """
    layout = state.trial.fit.network.layout
    for option in sorted(refused, key=worth)[:N_EXCHANGED]:
        for finding in state.findings:
            here, there = ({n for e in j.effects for n in touched_nodes(e, layout)} for j in (option, finding.judged))
            if here & there and len(option.effects) == 1 and worth(option) < worth(finding.judged):
                replaced = partial(_in_place_of, state, finding, option, needed)
                if state.attempt(replaced, f"{option.labels} in place of {finding.judged.labels}"):
                    return True
    return False


def _in_place_of(state: Search, finding: Finding, option: Judged, needed: float) -> bool:
    """Take an option instead of a finding, if it is likelier by the odds asked for and passes; return whether it did."""
    places = {effect.place for effect in finding.effects}
    kept = _attempted_without(state, places)
    if kept is None:
        return False
    without, lost = kept
    trial = try_effects(option.trial, (*without.effects, *option.effects), n_passes=12)
    instead = Judged(trial.effects[len(without.effects) :], weigh(without, trial, max(state.n_named, 1)), trial)
    if instead.evidence.log_bayes_factor <= lost + needed:
        return False
    examined, _ = examine(without, instead, needed)
    if examined.reason:
        return False
    state.rejected = [j for j in state.rejected if j.effects != option.effects]
    state.rejected.append(replace(finding.judged, reason=OUTDONE))
    state.findings = [Finding(examined) if f is finding else f for f in state.findings]
    state.trial = trial
    return True


def prune(state: Search, needed: float) -> None:
    """Drop findings, and members of a set that was found together, that the others have made superfluous."""
    for finding in list(state.findings):
        for effect in finding.effects if len(finding.effects) > 1 or finding is not state.findings[-1] else ():
            if all(other.place == effect.place for other in state.trial.effects):
                continue
            kept = _attempted_without(state, {effect.place})
            if kept is not None and kept[1] <= needed:
                _drop(state, {effect.place}, *kept)


def _attempted_without(state: Search, places: Collection[object]) -> tuple[Trial, float] | None:
    """Return the trial without the effects at places, and their log Bayes factor; None where it cannot be computed."""

    def weighed() -> tuple[Trial, float]:
        others = [effect for effect in state.trial.effects if effect.place not in places]
        without = try_effects(state.trial, others, n_passes=10) if others else state.base
        return without, weigh(without, state.trial, 1).log_bayes_factor

    return state.attempt(weighed, "the model without " + " and ".join(str(place) for place in places))


def _drop(state: Search, places: Collection[object], without: Trial, lost: float) -> None:
    """Go on without the effects at places, whose log Bayes factor was ``lost``."""
    state.trial = without
    for place in places:
        state.findings = [f.without(place, lost, without) for f in state.findings]
    state.findings = [f for f in state.findings if f.effects]
