"""The second look, at open-loop trajectories: where misfit is too large for the innovations to lead the way.

Long trajectories forgive effects that merely resemble what is missing, so what they suggest must be supported by the
innovations too: once, for one set of effects, not for one among many. Where the likeliest set does not hold, another one
that the trajectories like less is no better a name.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import comb

from twin_core.discover.confirm import (
    Trial,
    about_trajectory,
    resettled,
    try_on_trajectories,
    weigh_trajectories,
)
from twin_core.discover.judge import Judged, Search, accept, is_close, once_each
from twin_core.discover.shortlist import LATENT_SHARES, best_of_each_place, refined, screened, shortlist
from twin_core.effects.base import Effect

N_REFITS = 6
TOGETHER_MISFIT_SHARE = 3.0
"""Misfit over noise above which effects are tried together."""

MOST_TOGETHER = 2
"""Effects that are tried together where none helps alone: more fit anything on a long trajectory."""

LEAST_MISFIT_SHARE = 0.3
"""Misfit over noise below which trajectories have nothing to add to the innovations."""

NOT_BY_BOTH = "open-loop residuals suggest it, the filter's innovations do not support it"
N_KEPT = 4
"""Sets of effects that are extended by one more."""


def extend_by_trajectory(state: Search, needed: float, *, fallback: bool) -> bool:
    """Add the effect, or the effects that only pay off together, that open-loop residuals suggest; False if none holds.

    Parameters
    ----------
    state
        The model so far; it grows by what is found.
    needed
        Log Bayes factor that is asked for.
    fallback
        Whether to try the effects without a name.
    """
    misfit = state.trial.misfit_share
    if misfit < LEAST_MISFIT_SHARE:
        return False
    seeds = [state.trial]
    for n_together in range(1, 2 if fallback or misfit < TOGETHER_MISFIT_SHARE else MOST_TOGETHER + 1):
        judged = [j for seed in seeds for j in _extended(state, seed, n_together, needed, fallback=fallback)]
        sets = once_each(judged)[:N_KEPT]
        if not sets:
            break
        state.rejected += [replace(j, reason=NOT_BY_BOTH) for j in sets]
        if accept(state, _supported(state, sets if fallback else sets[:1], needed), needed):
            close = tuple(j for j in sets[1:] if is_close(j, sets[0]))
            state.findings[-1] = replace(state.findings[-1], alternatives=close)
            return True
        seeds = [j.trial for j in sets]
    return False


def _extended(state: Search, seed: Trial, n_together: int, needed: float, *, fallback: bool) -> list[Judged]:
    """Return what one more effect makes of a trial, judged against the state's model."""
    calibration = seed.calibration
    fit = about_trajectory(calibration.problem, calibration.optimum)
    screenings = screened(seed, fit, LATENT_SHARES, fallback=fallback)
    rankings = [best_of_each_place(screening.probes, seed.n_samples) for screening in screenings]
    n_tried = state.count(max(len(ranked) for ranked in rankings), fallback=fallback)
    judged = []
    for effect in refined(fit, shortlist(rankings, needed, N_REFITS)):
        work = partial(_fitted, state, seed, effect, comb(n_tried, n_together))
        judged.append(state.attempt(work, f"{effect.label} on trajectories"))
    return [j for j in judged if j is not None]


def _fitted(state: Search, seed: Trial, effect: Effect, n_tried: int) -> Judged | None:
    """Return one more effect on top of a trial, fitted on trajectories; None where the balance has no solution."""
    trial = try_on_trajectories(seed, (*seed.present_effects, effect))
    if trial is None:
        return None
    evidence = weigh_trajectories(state.trial, trial, n_tried)
    return Judged(trial.effects[len(state.trial.effects) :], evidence, trial)


def _supported(state: Search, options: Sequence[Judged], needed: float) -> list[Judged]:
    """Return the options that the innovations make likelier too, with their parameters fitted to these.

    The freedom of an option has been paid for where it was chosen, on trajectories.
    """
    likely = [j for j in options if j.evidence.log_bayes_factor > needed]
    trials = [state.attempt(partial(resettled, state.trial, j.trial), f"{j.labels} on trajectories") for j in likely]
    settled = [replace(j, trial=trial) for j, trial in zip(likely, trials, strict=True) if trial is not None]
    return [j for j in settled if j.trial.fit.log_posterior - state.trial.fit.log_posterior > needed]
