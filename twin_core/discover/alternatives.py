"""Alternatives: names that a network which is visibly coarse cannot tell from the one that was found.

Evidence compares readings with their noise. What a coarse network leaves beside any name is no noise: it leans towards one
name or another by many nats that say nothing. There, names that explain as much are alternatives, as are those that the evidence
itself hardly tells from the best one.
"""

from collections.abc import Collection
from dataclasses import replace
from functools import partial

import numpy as np

from twin_core.calibrate.second_order import Calibration
from twin_core.calibrate.undeclared.model import HeatFit
from twin_core.discover import policy
from twin_core.discover.evidence import weigh
from twin_core.discover.judge import Finding, Judged, Search, once_each
from twin_core.discover.shortlist import UNDECLARED_SHARES, best_of_each_place, refined, screened
from twin_core.discover.trial import (
    Trial,
    about_trajectory,
    by_chance,
    explained,
    mean_excess,
    resettled,
    shared_unknowns,
    try_on_trajectories,
)
from twin_core.effects.base import Effect, Place

N_COMPARED = 8
"""Other names, no less simple, that are fitted at most from either start, the best ones by linear screening first."""


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
    starts = [simple.calibration()]
    bare = state.attempt(
        partial(_bare, simple, state.trial.calibration()), "the parameters found, without " + own.label
    )
    starts += [bare] if bare is not None else []

    about = [about_trajectory(start.problem, start.optimum) for start in starts]
    fits = [(simple.fit, starts[0]), *zip(about, starts, strict=True)]

    def in_place(effect: Effect) -> str:
        return f"{effect.label} instead of {own.label}"

    options = [(start, effect) for fit, start in fits for effect in _near(simple, fit, own, known)]
    fitted = state.attempt_each(
        [
            (partial(_explaining, simple, start, effect, state.trial, least), in_place(effect))
            for start, effect in options
        ]
    )
    best: dict[Place, Trial] = {}
    for trial in sorted((trial for trial in fitted if trial is not None), key=lambda trial: trial.unexplained()):
        best.setdefault(trial.effects[-1].place, trial)
    told = state.attempt_each(
        [(partial(_supported, state, simple, t, needed), in_place(t.effects[-1])) for t in best.values()]
    )
    return Finding(finding.judged, (*finding.alternatives, *once_each([j for j in told if j is not None])))


def _near(simple: Trial, about: HeatFit, own: Effect, known: Collection[Place]) -> list[Effect]:
    """Return the effects that linear screening about a fit hardly tells from one that was found, the best first."""
    probes = best_of_each_place(
        screened(simple, about, UNDECLARED_SHARES[-1:], fallback=False)[0].probes, simple.n_samples
    )
    gains = {p.effect.place: p.gain for p in probes if len(p.effect.parameter_specs()) <= len(own.parameter_specs())}
    near = (1.0 - policy.REPEATABLE_SHARE) * gains.get(own.place, 0.0)
    others = [p.effect for p in probes if p.effect.place not in known and gains.get(p.effect.place, -1.0) >= near]
    return refined(about, others[:N_COMPARED])


def _bare(simple: Trial, found: Calibration) -> Calibration:
    """Return the model without a finding at the parameters that it has with it: all that is missing there is what was found.

    Fitted without it, parameters make up for it as well as they can, and far from there nothing answers linearly.

    Raises
    ------
    ArithmeticError
        Where it has no solution there.
    """
    problem = simple.fit.problem
    unknowns = found.optimum.unknowns[shared_unknowns(found, problem)]
    fit = problem.solve(unknowns)
    if not np.isfinite(fit.cost):
        raise ArithmeticError("the heat balance has no solution there")
    return replace(found, problem=problem, optimum=replace(found.optimum, unknowns=unknowns, fit=fit))


def _explaining(simple: Trial, start: Calibration, effect: Effect, found: Trial, least: float) -> Trial | None:
    """Return an effect on top of a trial, fitted on trajectories, if it explains so much, gradients as with what was found."""
    trial = try_on_trajectories(simple, (*simple.present_effects, effect), start)
    return None if trial is None or explained(simple, trial, found) < least else trial


def _supported(state: Search, simple: Trial, trial: Trial, needed: float) -> Judged | None:
    """Return the last effect of a trial that was fitted on trajectories if the readings support it.

    The undeclared heat beside it is a first guess, while the simpler model's was fitted: where that speaks against the effect, it
    is fitted too.
    """
    n_tried = max(state.n_named, 1)
    evidence = weigh(simple, trial, n_tried)
    if evidence.log_bayes_factor <= needed:
        trial = resettled(simple, trial)
        evidence = weigh(simple, trial, n_tried)
    return Judged(trial.effects[-1:], evidence, trial) if evidence.log_bayes_factor > needed else None
