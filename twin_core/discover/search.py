"""The search: which effects, alone or together, the training record supports. It never sees a hold-out."""

import time
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np

from twin_core._typing import Progress, no_progress
from twin_core.calibrate.containment import NO_DEADLINE
from twin_core.calibrate.undeclared.model import gain_of_undeclared_heat
from twin_core.discover import policy
from twin_core.discover.coarseness import stands
from twin_core.discover.complete import complete
from twin_core.discover.evidence import Evidence, weigh
from twin_core.discover.exchange import exchange
from twin_core.discover.form import acts_at
from twin_core.discover.judge import (
    LESS_LIKELY,
    NO_FORESIGHT,
    SIZE_NOT_DETERMINED,
    Judged,
    Search,
    accept,
    is_close,
    once_each,
    threshold,
    worth,
)
from twin_core.discover.restart import restart
from twin_core.discover.revision import (
    foretell_together,
    prune,
    reconsider,
    tell_alternatives,
    withdraw,
    withdraw_superfluous,
)
from twin_core.discover.screen import Probe, joint_gain, projected_responses, survey_of
from twin_core.discover.shortlist import UNDECLARED_SHARES, best_of_each_place, refined, screened, shortlist
from twin_core.discover.trajectories import (
    LEAST_MISFIT_SHARE,
    SETTLING_NATS,
    TOGETHER_MISFIT_SHARE,
    extend_beside_gradients,
    extend_by_trajectory,
)
from twin_core.discover.trial import Trial, converged, resettled, try_effects
from twin_core.effects.base import Effect, Place
from twin_core.progress import Part

MAX_FINDINGS = 4
LOOKS = 0.6
"""Fraction of the progress at which the looks for effects end. Each look is given half of what is left of it, since most searches
end after the first or second."""

N_REFITS = 12
N_FREE_PLACES = 2
"""Places at the head of each ranking at which a heat without a name is tried in all its forms."""

N_PAIR_PROBES = 16
N_PAIR_REFITS = 5
N_SETTLED = 3
RIVAL_NATS = 20.0
"""Forms this near the best one at its place are compared once more."""

N_FORMS = 4
"""Other forms where the best option acts that are fitted further."""

REVISION_SHARE = 0.25
"""Share of the search's time that is left for looking over what was found: what has not been is no answer yet. A
search without a deadline is not touched by it."""

WIDENED = 1.0
"""Variance that stays beside a finding, in units of the sensors' noise, from which pairs and trajectories are asked as well."""

N_FIRST = 2
"""Options that screening puts first are always fitted further: a few passes tell more of the undeclared heat's size."""

UNSEEN = (NO_FORESIGHT, LESS_LIKELY, SIZE_NOT_DETERMINED)
"""Why a single effect may be refused that is seen only beside another one."""

N_UNSEEN = 2
"""Effects refused so that are extended by another one, where the data hardly tell them apart: a limit of time. A load that
ended was not found at 1, where two that differ by 0.05 nats changed places, and was at 2 and 4."""


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
        On the clock of ``time.monotonic``: what is not fitted by then is left out, and told. A part of the time is kept for
        the revision of what was found.
    first
        Places of effects that spacecraft of the same design have.
    progress
        Called with the fraction done.

    Returns
    -------
    Search
        With the findings in the order in which they were made.
    """
    state = Search(base, base, deadline=deadline, first=first, progress=Part(progress))
    state.progress(0.0, "settling the declared model")
    _converge(state)
    state.base = state.trial
    needed = threshold(false_alarm_rate)
    now = time.monotonic()
    looking = now + (1.0 - REVISION_SHARE) * (deadline - now)
    for step in range(MAX_FINDINGS):
        begun, done = (LOOKS * (1.0 - 0.5**n) for n in (step, step + 1))
        with state.during(begun, done, f"effect {step + 1}: "):
            if not _look(state, needed, looking):
                break
    state.progress(LOOKS, "revising what was found")
    foretell_together(state)
    withdraw(state, needed)
    withdraw_superfluous(state, needed)
    if not state.findings:
        state.progress(0.65, "looking beside temperature gradients within the nodes")
        with state.until(looking):
            _look_beside_gradients(state, needed)
        withdraw(state, needed)
        withdraw_superfluous(state, needed)
    if not state.findings:
        with state.until(looking), state.during(0.7, 0.8, "a repeatable heat flow: "):
            _extend(state, needed, fallback=True)
        withdraw(state, needed)
    reconsider(state, needed)
    withdraw_superfluous(state, needed)
    with state.during(0.8, 1.0, "comparing with other names"):
        state.progress(0.0, "")
        tell_alternatives(state, needed)
    return state


def _look(state: Search, needed: float, deadline: float) -> bool:
    """Look for one more effect, or pair, and revise what was found with it; False if nothing more holds."""
    state.progress(0.0, "settling the model so far")
    _converge(state)
    state.past = (*state.past, state.trial)
    known = _places(state)
    with state.until(deadline), state.during(0.0, 0.85):
        if not _extend(state, needed, fallback=False):
            return False
    state.progress(0.85, "completing what was found")
    complete(state, needed)
    state.progress(0.9, "fitting it from other settings")
    restart(state)
    _converge(state)
    state.progress(0.95, "revising what was found")
    prune(state, needed)
    state.progress(0.97, "trying other names in its place")
    exchange(state, needed)
    return _places(state) != known  # what was found and does not hold the next look would find again


def _converge(state: Search) -> None:
    """Take the fit of the model so far to its end, for it is what anything else is weighed against."""
    what = "a closer fit of " + ("what was found" if state.findings else "the declared model")
    state.trial = state.attempt(partial(converged, state.trial), what) or state.trial


def _nothing_is_missing(state: Search, needed: float) -> bool:
    """Return whether trajectories fit, or no heat is missing that the odds asked for would support."""
    if state.attempt(lambda: bool(state.trial.excess().max() < policy.LEAST_EXCESS), "how well trajectories fit"):
        return True
    missing = state.attempt(partial(gain_of_undeclared_heat, state.trial.fit), "how much heat is missing")
    return missing is not None and missing <= needed


def _look_beside_gradients(state: Search, needed: float) -> None:
    """Add an effect that shows beside gradients within the nodes alone, if one holds and anything is missing."""
    if _nothing_is_missing(state, needed):
        return
    what = "candidates beside gradients within the nodes"
    if state.attempt(partial(extend_beside_gradients, state, needed), what):
        complete(state, needed)
        restart(state)
        _converge(state)
        prune(state, needed)


def _places(state: Search) -> set[Place]:
    """Return where the findings of a search act."""
    return {effect.place for finding in state.findings for effect in finding.effects}


def _extend(state: Search, needed: float, *, fallback: bool) -> bool:
    """Add the best supported effect, or pair of effects, to the state; False if none is supported or nothing is missing."""
    if _nothing_is_missing(state, needed):
        return False
    state.attempt(state.trial.log_evidence, "the evidence for the model before")  # every fork would find it anew
    what = "effects without a name" if fallback else f"candidates for effect {len(state.findings) + 1}"
    widened = not state.findings or state.trial.unexplained() > WIDENED
    by_heat, by_trajectory = state.fork(), state.fork()
    first = partial(_extend_by_heat, by_heat, needed, fallback=fallback)
    with by_heat.during(0.0, 0.5):
        told, rankings = state.attempt(first, f"{what}, by what the filter leaves") or (False, [[]])
    # After the first finding pairs are left to the trajectories: by heat they took as long again and added none.
    if not (told or fallback or state.findings):
        with by_heat.during(0.5, 0.6, "two at a time, "):
            told = bool(state.attempt(partial(_pairs_by_heat, by_heat, rankings[0], needed), f"{what}, two at a time"))
    after = by_heat.trial
    if not widened or (told and after.unexplained() <= policy.MOST_COARSENESS and stands(state.trial, after)):
        state.join(by_heat)
        return told

    def look(fork: Search, seeds: Sequence[Trial], n_together: int) -> tuple[bool, list[Trial]]:
        known = by_heat.findings[-1] if told else None
        second = partial(
            extend_by_trajectory, fork, needed, seeds, rankings[-1], n_together, fallback=fallback, known=known
        )
        with fork.during(*((0.6, 0.8, "") if n_together == 1 else (0.8, 1.0, "two together, "))):
            return state.attempt(second, f"{what}, by open-loop residuals") or (False, [])

    def leaves(trial: Trial) -> float:
        return state.attempt(trial.misfit_share, "how much trajectories leave") or 0.0

    by_pairs, paired = state.fork(), False
    misfit = leaves(state.trial)
    seen, sets = look(by_trajectory, [state.trial], 1) if misfit >= LEAST_MISFIT_SHARE else (False, [])
    least = min([misfit, *(leaves(fork.trial) for fork, found in ((by_heat, told), (by_trajectory, seen)) if found)])
    if not fallback and sets and least >= TOGETHER_MISFIT_SHARE:
        beside = [] if told else _unseen_by_trajectories(by_heat.rejected[len(state.rejected) :])
        paired, _ = look(by_pairs, [*sets, *beside], 2)
    options = [fork for fork, found in ((by_heat, told), (by_trajectory, seen), (by_pairs, paired)) if found]
    n = len(state.rejected)
    refused = [*by_trajectory.rejected, *by_pairs.rejected[n:], *by_heat.rejected[n:]]
    if not options:
        state.rejected, state.n_named = refused, max(by_heat.n_named, by_trajectory.n_named)
        return False
    state.join(min(options, key=lambda fork: fork.findings[-1].foresight))
    state.rejected = [j for j in refused if j.places != state.findings[-1].judged.places]
    return True


def _unseen_by_trajectories(refused: Sequence[Judged]) -> list[Trial]:
    """Return the likeliest single effects that were refused for what they do to trajectories, those that data hardly tell apart.

    A lagging sensor, say, shows between neighbouring readings and changes no long trajectory; what does may show beside it only.
    Nor is the size of an effect determined where the model's parameters follow another one that is missing too.
    """
    singles = sorted((j for j in refused if j.reason in UNSEEN and len(j.effects) == 1), key=worth)
    return [j.trial for j in singles[:N_UNSEEN] if j is singles[0] or is_close(j, singles[0])]


def _extend_by_heat(state: Search, needed: float, *, fallback: bool) -> tuple[bool, list[list[Probe]]]:
    """Extend by the effect that innovations suggest beside undeclared heat; tell whether one holds, and how all rank.

    There is one ranking for each size of the undeclared heat, the largest first.
    """
    state.progress(0.0, "screening candidates")
    screenings = screened(state.trial, state.trial.fit, UNDECLARED_SHARES, fallback=fallback)
    rankings = [best_of_each_place(screening.probes, state.trial.n_samples) for screening in screenings]
    n_tried = state.count(max(len(ranked) for ranked in rankings), fallback=fallback)
    if fallback:
        some = {probe.effect.place for ranked in rankings for probe in ranked[:N_FREE_PLACES] if probe.gain > needed}
        chosen = [probe.effect for probe in screenings[0].probes if probe.effect.place in some]  # of every degree
    else:
        chosen = refined(state.trial.fit, shortlist(rankings, needed, N_REFITS, state.first))
    return _accept_settled(state, [(effect,) for effect in chosen], n_tried, needed), rankings


def _pairs_by_heat(state: Search, ranked: Sequence[Probe], needed: float) -> bool:
    """Extend by the two effects that innovations suggest together; False if none is supported."""
    state.progress(0.0, "screening candidates")
    pairs = _best_pairs(ranked, state.trial, needed)
    return _accept_settled(state, pairs, max(state.n_named**2 // 2, 1), needed)


def _accept_settled(state: Search, options: Sequence[tuple[Effect, ...]], n_tried: int, needed: float) -> bool:
    """Keep the best option that passes, fitted until it settles; False if none does."""
    before = state.trial
    with state.during(0.2, 0.7):
        judged = _by_heat(state, options, n_tried)
    state.progress(0.7, "examining candidates")
    if not accept(state, judged, needed):
        return False
    state.progress(0.9, "settling what was found")
    _settle(state, before, n_tried)
    return True


def _settle(state: Search, before: Trial, n_tried: int) -> None:
    """Fit the last finding from its open-loop optimum too, and go on from the likelier fit.

    What is tried beside it is weighed against it: where its own fit ended early, anything is likelier.
    """
    finding = state.findings[-1]

    def work() -> tuple[Trial, Evidence]:
        trial = resettled(before, finding.judged.trial)
        return trial, weigh(before, trial, n_tried)

    settled = state.attempt(work, f"{finding.judged.labels} from its optimum")
    if settled is None or settled[0].fit.log_posterior <= finding.judged.trial.fit.log_posterior:
        return
    trial, evidence = settled
    own = {effect.place for effect in finding.effects}
    effects = tuple(effect for effect in trial.effects if effect.place in own)
    judged = replace(finding.judged, effects=effects, evidence=evidence, trial=trial)
    state.findings[-1], state.trial = replace(finding, judged=judged), trial


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

    first = [partial(_judge, state, state.trial, option, n_tried, n_passes=3, quick=True) for option in options]
    labels = [" with ".join(effect.label for effect in option) for option in options]
    told = state.progress.part(0.0, 0.5, "fitting candidate ")
    quick = _done(state.attempt_each(list(zip(first, labels, strict=True)), told))
    judged = sorted(quick, key=worth)
    best = judged[0].evidence.log_bayes_factor if judged else 0.0
    near = [j for j in judged[:N_SETTLED] if j.evidence.log_bayes_factor > best - SETTLING_NATS]
    here = acts_at(judged[0].trial, judged[0].effects) if judged else set()
    likely = [j for j in judged if j.evidence.log_bayes_factor > best - SETTLING_NATS]
    rivals = [*quick[:N_FIRST], *[j for j in likely if acts_at(j.trial, j.effects) == here][:N_FORMS]]
    near += [j for i, j in enumerate(rivals) if all(j is not n for n in [*near, *rivals[:i]])]
    further = [(partial(_judge, state, j.trial, j.effects, n_tried, n_passes=12), j.labels) for j in near]
    settled = _done(state.attempt_each(further, state.progress.part(0.5, 0.9, "fitting the best further, ")))
    rest = [j for j in judged if all(j is not n for n in near)]
    forms = _forms_of_the_best(settled)
    works = [(partial(_from_trajectories, state, j, n_tried), j.labels) for j in forms]
    compared = _done(state.attempt_each(works, state.progress.part(0.9, 1.0, "fitting its rivals, ")))
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
    here = acts_at(best.trial, best.effects)
    rivals = [j for j in simple if acts_at(j.trial, j.effects) == here]
    return rivals if len({j.trial.effects[-1].place for j in rivals}) > 1 else []


def _from_trajectories(state: Search, judged: Judged, n_tried: int) -> Judged:
    """Return an option fitted from its open-loop optimum too, at the likelier of both fits."""
    trial = resettled(state.trial, judged.trial)
    return Judged(trial.effects[len(state.trial.effects) :], weigh(state.trial, trial, n_tried), trial)


def _judge(
    state: Search, start: Trial, option: tuple[Effect, ...], n_tried: int, *, n_passes: int, quick: bool = False
) -> Judged:
    """Fit an option on top of the state's effects, started from a trial close by."""
    trial = replace(
        try_effects(start, (*state.trial.effects, *option), n_passes=n_passes), simpler=state.trial, below=state.trial
    )
    found = trial.effects[len(state.trial.effects) :]
    return Judged(found, weigh(state.trial, trial, n_tried, quick=quick), trial)
