"""Alternatives: names that a network which is visibly coarse cannot tell from the one that was found.

Evidence compares readings with their noise. What a coarse network leaves beside any name is no noise: it leans towards one
name or another by many nats that say nothing. There, names that explain as much are alternatives, as are those that the evidence
itself hardly tells from the best one.
"""

from collections.abc import Collection, Sequence
from functools import partial
from itertools import chain

import numpy as np

from twin_core.calibrate.containment import attempted
from twin_core.calibrate.second_order import Calibration
from twin_core.discover import policy
from twin_core.discover.evidence import weigh
from twin_core.discover.form import acts_at
from twin_core.discover.judge import Finding, Judged, Search, once_each
from twin_core.discover.shortlist import (
    UNDECLARED_SHARES,
    best_of_each_place,
    each_start,
    refined,
    screened,
    screened_beside_gradients,
    shortlist,
)
from twin_core.discover.trajectories import starts_beside_gradients
from twin_core.discover.trial import (
    Trial,
    about_trajectory,
    bare,
    by_chance,
    explained,
    mean_excess,
    resettled,
    resettled_near,
    try_on_trajectories,
)
from twin_core.effects.base import Effect, Place

N_COMPARED = 32
"""Other names, no less simple, that are fitted at most, the best ones by linear screening first: parameters make up for another
law, or for a neighbouring place, by so much more than linear responses tell that right names came as late as thirtieth."""

N_BEFORE = 8
"""Names that are fitted at most from the simpler model as it was fitted, of each linear screening about it."""

N_BESIDE_GRADIENTS = 6
"""Names that are fitted at most of those that stand out beside gradients within the nodes, where the right one often comes
first: heat that wanders at the nodes, or trajectories alone, may put it behind dozens of others."""

N_VARIED = 6
"""Settings from which each name is fitted that acts where the finding does: a thermostat is easily caught at wrong switchings."""

HOPELESS_NATS = 10.0
"""A limit of time. Names that are so much less likely than is asked for, fitted from the simpler model's heat, are not fitted
from their own trajectories too: of 31 that were not supported either way, these ended 7 nats higher at most."""


def add_coarse_alternatives(state: Search, simple: Trial, finding: Finding, needed: float) -> Finding:
    """Return a finding of one name with the names that explain as much of what it explains, where the network is coarse.

    Parameters
    ----------
    state
        With the finding.
    simple
        The state's model without it.
    finding
        Of a single effect that has a name; others are returned as they are.
    needed
        Log Bayes factor that is asked for.
    """
    left = mean_excess(state.trial)
    own = finding.effects[0]
    if len(finding.effects) != 1 or own.fallback or left <= by_chance(state.trial.n_samples):
        return finding
    least = (1.0 - policy.REPEATABLE_SHARE) * explained(simple, state.trial)
    known = {e.place for option in (finding.judged, *finding.alternatives) for e in option.effects}
    goal = _cost_of_explaining(simple, state.trial, least)
    fitted_before, found = simple.calibration(), state.trial.calibration()
    start = state.attempt(partial(bare, simple, found), "the parameters found, without " + own.label) or fitted_before
    what = f"names that may explain what {own.label} does"
    near = state.attempt(partial(_near, simple, start, found, own, known), what) or []
    before = state.attempt(partial(_near_before, simple, own, known), what) or []
    beside = state.attempt(partial(_near_beside_gradients, simple, own, known), what) or []
    options = [
        *((effect, [start]) for effect in near),
        *((effect, [fitted_before]) for effect in before),
        *((effect, starts_beside_gradients(simple)) for effect in beside),
    ]
    best = _best_of_each_place(state, simple, finding, options, least, goal)
    as_screened = {effect.place: effect for effect in reversed(near)}
    told = state.attempt_each(
        [
            (
                partial(_supported, state, simple, t, as_screened.get(t.effects[-1].place), needed),
                f"{t.effects[-1].label} instead of {own.label}",
            )
            for t in best
        ],
        state.progress.part(0.8, 1.0, ", weighing "),
    )
    return Finding(finding.judged, (*finding.alternatives, *once_each([j for j in told if j is not None])))


def _best_of_each_place(
    state: Search,
    simple: Trial,
    finding: Finding,
    options: Sequence[tuple[Effect, Sequence[Calibration]]],
    least: float,
    goal: float,
) -> list[Trial]:
    """Return names as good as what was found, the one of each place that leaves the least.

    A place is fitted from its other starts only where the first one ended where readings are less likely than with the finding.
    """
    enough, found = state.trial.log_evidence() - policy.ALTERNATIVE_NATS, state.trial
    best: dict[Place, Trial] = {}
    told: set[Place] = set()
    places = [effect.place for effect, _ in options]
    is_first = [places.index(place) == i for i, place in enumerate(places)]
    first, then = state.progress.part(0.2, 0.6, ", "), state.progress.part(0.6, 0.8, " from other starts, ")
    for turn, progress in ((True, first), (False, then)):
        asked = [o for o, own in zip(options, is_first, strict=True) if own is turn and o[0].place not in told]
        works = [partial(_explaining, simple, starts, effect, found, least, goal) for effect, starts in asked]
        labels = [f"{effect.label} instead of {finding.judged.labels}" for effect, _ in asked]
        for trial in state.attempt_each(list(zip(works, labels, strict=True)), progress):
            if trial is None:
                continue
            place = trial.effects[-1].place
            if place not in best or trial.unexplained() < best[place].unexplained():
                best[place] = trial
            if trial.least_evidence > enough or trial.log_evidence() > enough:
                told.add(place)
    return sorted(best.values(), key=lambda trial: trial.unexplained())


def _near(simple: Trial, start: Calibration, found: Calibration, own: Effect, known: Collection[Place]) -> list[Effect]:
    """Return the names that linear screening about the trajectories found puts first, at the simpler model's parameters."""
    about = about_trajectory(start.problem, start.optimum, found)
    screening = screened(simple, about, UNDECLARED_SHARES[-1:], fallback=False)[0]
    most = own.n_free
    probes = [p for p in screening.probes if p.effect.place not in known and p.effect.n_free <= most]
    near = [probe.effect for probe in best_of_each_place(probes, simple.n_samples)[:N_COMPARED]]
    here = acts_at(simple, (own,))
    varied = [
        [p.effect for p in probes if p.effect.place == effect.place][:N_VARIED]
        for effect in near
        if acts_at(simple, (effect,)) == here
    ]
    return each_start([*refined(about, near), *chain.from_iterable(varied)])


def _near_before(simple: Trial, own: Effect, known: Collection[Place]) -> list[Effect]:
    """Return the names that explain about as much linearly as what was found, about the simpler model as it was fitted.

    What was found may have taken parameters to where no other name is near.
    """
    calibration = simple.calibration()
    chosen: list[Effect] = []
    for about in (simple.fit, about_trajectory(calibration.problem, calibration.optimum)):
        screening = screened(simple, about, UNDECLARED_SHARES[-1:], fallback=False)[0]
        probes = best_of_each_place(screening.probes, simple.n_samples)
        gains = {p.effect.place: p.gain for p in probes if p.effect.n_free <= own.n_free}
        least = (1.0 - policy.REPEATABLE_SHARE) * gains.get(own.place, 0.0)
        others = [p.effect for p in probes if p.effect.place not in known and gains.get(p.effect.place, -1.0) >= least]
        chosen += refined(about, others[:N_BEFORE])
    return each_start(chosen)


def _near_beside_gradients(simple: Trial, own: Effect, known: Collection[Place]) -> list[Effect]:
    """Return the names that stand out beside gradients within the nodes, about the simpler model fitted beside them."""
    screened_there = screened_beside_gradients(simple)
    if screened_there is None:
        return []
    about, screenings = screened_there
    most = own.n_free
    rankings = [best_of_each_place(screening.probes, simple.n_samples) for screening in screenings]
    others = [[p for p in ranked if p.effect.place not in known and p.effect.n_free <= most] for ranked in rankings]
    return refined(about, shortlist(others, 0.0, N_BESIDE_GRADIENTS))


def _cost_of_explaining(simple: Trial, found: Trial, least: float) -> float:
    """Return the cost of the readings above which no effect explains as much of what a simpler trial leaves as is asked for.

    Gradients can take no more from what an effect leaves than their share, and a sensor's noise counts up to ``LARGEST_NOISE``
    times what costs are weighed by.
    """
    share = found.share_of_gradients()
    if share >= 1.0:
        return np.inf
    stays = max(simple.left_beside(share), mean_excess(simple) - policy.MOST_COARSENESS) - least
    n_readings = sum(segment.valid.sum(axis=0) for segment in simple.fit.problem.segments)
    mean_square = (1.0 + stays / (1.0 - share)) * policy.LARGEST_NOISE**2
    return float(0.5 * mean_square * n_readings.size * n_readings.max())


def _explaining(
    simple: Trial, starts: Sequence[Calibration], effect: Effect, found: Trial, least: float, goal: float
) -> Trial | None:
    """Return an effect on top of a trial, fitted on trajectories, if it is as good a name as what was found.

    It explains so much, gradients as with what was found, or the readings hardly tell it from that, or are likelier. Of one that
    would explain far less, at a cost above ``goal``, only wandering heat is asked beside it.
    """
    trial = try_on_trajectories(simple, (*simple.present_effects, effect), *starts, goal=goal)
    if trial is None:
        return None
    enough = found.log_evidence() - policy.ALTERNATIVE_NATS
    if trial.near[0].status == "given_up":
        return trial if trial.least_evidence > enough else None
    likely = trial.log_evidence() > enough  # asked of every one, here, where several are fitted at once
    return trial if likely or explained(simple, trial, found) >= least else None


def _supported(state: Search, simple: Trial, trial: Trial, start: Effect | None, needed: float) -> Judged | None:
    """Return the last effect of a trial that was fitted on trajectories if the readings support it.

    Near what was found, the parameters make room for that, and another name may be caught at a time constant of minutes in place
    of seconds: it is fitted from its ``start`` there and the simpler model as it was fitted too, and the closer fit counts. The
    undeclared heat beside it is a first guess, while the simpler model's was fitted: where that speaks against the effect, it is
    fitted too.
    """
    if start is not None:
        reached = trial.near[0].fit.cost
        again = partial(
            try_on_trajectories, simple, (*simple.present_effects, start), simple.calibration(), goal=reached
        )
        other = attempted(again, "the same from the simpler model", [])  # its failure takes nothing from the first fit
        trial = trial if other is None or other.near[0].fit.cost >= reached else other
    n_tried, found = max(state.n_named, 1), trial
    evidence = weigh(simple, found, n_tried)
    for refit, least in ((resettled_near, -np.inf), (resettled, needed - HOPELESS_NATS)):
        if not least <= evidence.log_bayes_factor <= needed:
            break
        found = refit(simple, trial)
        evidence = weigh(simple, found, n_tried)
    return Judged(found.effects[-1:], evidence, found) if evidence.log_bayes_factor > needed else None
