"""The second look, at open-loop trajectories: where misfit is too large for the innovations to lead the way.

What long trajectories suggest is weighed as everything else is: against heat that wanders at the nodes, and against a misfit
that wanders at the sensors.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import comb

from twin_core.calibrate.second_order import Calibration
from twin_core.discover import policy
from twin_core.discover.evidence import weigh
from twin_core.discover.judge import Finding, Judged, Search, accept, once_each, worth
from twin_core.discover.screen import Probe
from twin_core.discover.shortlist import (
    UNDECLARED_SHARES,
    best_of_each_place,
    refined,
    screened,
    screened_beside_gradients,
    shortlist,
)
from twin_core.discover.trial import Trial, about_trajectory, resettled, try_on_trajectories
from twin_core.effects.base import Effect

N_REFITS, N_NEAR = 6, 9
"""Effects that are fitted on trajectories: suggested by what these leave, and by what the filter leaves beside little heat."""

TOGETHER_MISFIT_SHARE = 3.0
"""Misfit over noise from which two effects are tried together, if no single one brings it below: more fit anything on a long
trajectory."""

LEAST_MISFIT_SHARE = 0.3
"""Misfit over noise below which trajectories have nothing to add to the innovations."""

SETTLING_NATS = 40.0
"""Options this many nats of log evidence behind after a few passes are not fitted further: a limit of time, not of belief. A pair
that is found 201 nats likelier began 11 behind: missed at 0, found at 20, 40 and 80 in about the same time."""

Extension = tuple[Trial, Effect, int]
"""A trial, an effect to be fitted on top of it, and how many sets of effects were looked at to find it."""

N_KEPT, N_SETTLED = 4, 2
"""Sets of effects that are extended by one more, and that are fitted in the presence of undeclared heat too."""


def extend_by_trajectory(
    state: Search,
    needed: float,
    seeds: Sequence[Trial],
    near: Sequence[Probe],
    n_together: int,
    *,
    fallback: bool,
    known: Finding | None = None,
) -> tuple[bool, list[Trial]]:
    """Add the effects that open-loop residuals suggest, one on top of each seed; tell whether one holds, and what comes next.

    Parameters
    ----------
    state
        The model so far; it grows by what is found.
    needed
        Log Bayes factor that is asked for.
    seeds
        Trials that are extended by one more effect: the model so far, or what may only pay off together with another.
    near
        Candidates about the measured temperatures, screened beside little heat, the best first.
    n_together
        Effects that are added to the model so far.
    fallback
        Whether to try the effects without a name.
    known
        What is supported by what the innovations suggest: where it is the likeliest here too, it is not examined again, and seeds
        nothing where it leaves less than half of the variance of the error on what it was not fitted to.

    Returns
    -------
    bool, list of Trial
        The best trials are the seeds of a next look, at one effect more together.
    """
    state.progress(0.0, "screening along trajectories")
    own = _extensions(state, seeds, n_together, needed, fallback=fallback)
    # What the filter suggests beside little heat is no seed: it is far from where long trajectories point.
    close = _near_extensions(state, near, needed, fallback=fallback) if n_together == 1 else []
    works = [
        (partial(_fitted, state, *extension, beside_heat=heat), f"{extension[1].label} on trajectories")
        for some, heat in ((own, False), (close, True))
        for extension in some
    ]
    fitted = state.attempt_each(works, state.progress.part(0.3, 0.7, "fitting along trajectories, "))
    sets, best = (once_each([j for j in some if j is not None])[:N_KEPT] for some in (fitted[: len(own)], fitted))
    if not best:
        return False, []
    state.progress(0.7, "fitting the best further")
    options = [*_settled(state, best[:N_SETTLED], comb(state.n_named, n_together), needed), *best]
    if n_together > 1 and not fallback:
        options = [*_alone(state, best[0]), *options]
    if known is not None and min(options, key=worth).places == known.judged.places:
        foretells = policy.DOMINANCE * known.foresight**2 < 1.0
        return False, [] if foretells else [j.trial for j in sets]
    state.progress(0.8, "examining candidates")
    return accept(state, options, needed), [j.trial for j in sets]


def extend_beside_gradients(state: Search, needed: float) -> bool:
    """Add the effect that trajectories suggest beside gradients within the nodes; tell whether one holds.

    Where parameters have made up for what is missing, nothing else answers where it belongs: neither about the measured
    temperatures nor about the trajectories. Fitted beside gradients they need not make up for it. What was refused for what it
    predicts is not asked again.
    """
    screened_there = screened_beside_gradients(state.trial)
    if screened_there is None:
        return False
    about, screenings = screened_there
    rankings = [best_of_each_place(screening.probes, state.trial.n_samples) for screening in screenings]
    n_tried = state.count(max(state.n_named, *(len(ranked) for ranked in rankings)), fallback=False)
    refused = {j.effects[0].place for j in state.rejected if len(j.effects) == 1 and j.validation is not None}
    others = [[probe for probe in ranked if probe.effect.place not in refused] for ranked in rankings]
    starts = starts_beside_gradients(state.trial)

    def fitted(effect: Effect) -> Judged | None:
        trial = try_on_trajectories(state.trial, (*state.trial.present_effects, effect), *starts)
        return None if trial is None else _judged(state, trial, n_tried)

    effects = refined(about, shortlist(others, needed, N_REFITS))
    told = state.attempt_each([(partial(fitted, effect), f"{effect.label} beside gradients") for effect in effects])
    best = once_each([j for j in told if j is not None])
    return accept(state, [*_settled(state, best[:N_SETTLED], n_tried, needed), *best], needed)


def starts_beside_gradients(trial: Trial) -> list[Calibration]:
    """Return a trial's model fitted to trajectories, and beside gradients within the nodes."""
    calibration, gradients = trial.calibration(), trial.beside_any_gradients()
    if gradients is None:
        return [calibration]
    return [calibration, replace(calibration, problem=gradients.problem, optimum=gradients.optimum)]


def _extensions(
    state: Search, seeds: Sequence[Trial], n_together: int, needed: float, *, fallback: bool
) -> list[Extension]:
    """Return the effects that trajectories of some trials suggest on top of them."""

    def suggested(seed: Trial) -> tuple[list[Effect], int]:
        calibration = seed.calibration()
        fit = about_trajectory(calibration.problem, calibration.optimum)
        screenings = screened(seed, fit, UNDECLARED_SHARES, fallback=fallback)
        rankings = [best_of_each_place(screening.probes, seed.n_samples) for screening in screenings]
        return refined(fit, shortlist(rankings, needed, N_REFITS)), max(len(ranked) for ranked in rankings)

    found: list[Extension] = []
    works = [(partial(suggested, seed), "what trajectories suggest") for seed in seeds]
    for seed, told in zip(seeds, state.attempt_each(works), strict=True):
        if told is not None:
            effects, n_looked_at = told
            n_tried = comb(state.count(n_looked_at, fallback=fallback), n_together)
            found += [(seed, effect, n_tried) for effect in effects]
    return found


def _near_extensions(state: Search, near: Sequence[Probe], needed: float, *, fallback: bool) -> list[Extension]:
    """Return effects for the state's model that are screened about the measured temperatures, beside little heat.

    Where a model misses much, its own trajectories lie far from the measured ones, and what answers there is another effect.
    """
    effects = refined(state.trial.fit, shortlist([near], needed, N_NEAR))
    n_tried = state.count(max(len(near), 1), fallback=fallback)
    return [(state.trial, effect, n_tried) for effect in effects]


def _fitted(state: Search, seed: Trial, effect: Effect, n_tried: int, *, beside_heat: bool) -> Judged | None:
    """Return one more effect on top of a trial, fitted on trajectories; None where the balance has no solution."""
    trial = try_on_trajectories(seed, (*seed.present_effects, effect), beside_heat=beside_heat)
    if trial is None:
        return None
    return _judged(state, trial, n_tried)


def _alone(state: Search, judged: Judged) -> list[Judged]:
    """Return the effect that was added last to a set without the others, if it can be fitted, settled.

    From the model's own trajectories another effect may lead to it that is not needed once it is there.
    """

    def work() -> Judged | None:
        *_, last = judged.trial.present_effects
        trial = try_on_trajectories(state.trial, (*state.trial.present_effects, last), judged.trial.calibration())
        return None if trial is None else _judged(state, resettled(state.trial, trial), state.n_named)

    found = state.attempt(work, f"{judged.effects[-1].label} alone")
    return [] if found is None else [found]


def _judged(state: Search, trial: Trial, n_tried: int) -> Judged:
    """Return what speaks for a trial on top of the state's model."""
    return Judged(trial.effects[len(state.trial.effects) :], weigh(state.trial, trial, n_tried), trial)


def _settled(state: Search, options: Sequence[Judged], n_tried: int, needed: float) -> list[Judged]:
    """Return the options that are or may become likely, with their parameters fitted in the presence of undeclared heat too.

    Along trajectories the undeclared heat is left as it was: only beside it is seen how little of it an option needs.
    """

    def settled(judged: Judged) -> Judged:
        return _judged(state, resettled(state.trial, judged.trial), n_tried)

    likely = [j for j in options if j.evidence.log_bayes_factor > needed - SETTLING_NATS]
    done = state.attempt_each([(partial(settled, j), f"{j.labels} on trajectories") for j in likely])
    return [j for j in done if j is not None]
