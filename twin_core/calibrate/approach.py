"""From rough guesses to the neighbourhood of the optimum: the misfit counts as noise, and falls as the model improves.

Far from the optimum, and wherever a network is coarser than what it describes, residuals dwarf the noise of the sensors.
Weighed by that noise the priors say nothing, and the search runs into corners where parameters vanish and no longer move
the trajectories. Weighed by the misfit it stays where the model is sensible. Long records are first thinned.
"""

from dataclasses import replace

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.calibrate.containment import NO_DEADLINE
from twin_core.calibrate.optimise import Optimum, minimise
from twin_core.calibrate.problem import Fit, Problem, build_problem
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record, one_of_each

CAUTION = 3.0
"""The misfit is weighed as this many times itself: its samples are not independent of each other."""

MAX_ROUNDS, SETTLED = 6, 0.9
"""Rounds at most; a round that leaves more than this share of the misfit is the last."""

MAX_ITERATIONS, TOLERANCE = 20, 1e-3
"""Of the search within a round: neighbouring samples share their misfit, so that a cost that falls by less tells nothing."""

COARSE_SAMPLES, COARSE_READINGS, LEAST_COARSE = 1200, 30_000, 200
"""Records longer than twice this are thinned to about this many samples for a first approach; where sensors are many, to
samples of about so many readings, but no fewer than the last number."""


def misfit_K(problem: Problem, fit: Fit) -> float:
    """Return the root mean square residual beyond the sensors' noise, all sensors together."""
    residual = np.concatenate(problem.residuals(fit))
    if np.isfinite(problem.huber):  # outliers are no misfit: the median tells what the others do
        excess_K2 = float(np.nanmedian((residual / 0.6745) ** 2 - problem.noise_K**2))
    else:
        excess_K2 = float(np.nanmean(residual**2 - problem.noise_K**2))
    return float(np.sqrt(max(excess_K2, 0.0)))


def approach(
    problem: Problem,
    unknowns: FloatArray | None = None,
    *,
    tolerance: float = TOLERANCE,
    rounds: int = MAX_ROUNDS,
    stands_for: float = 1.0,
    deadline: float = NO_DEADLINE,
) -> Optimum:
    """Return an optimum in which noise and misfit are weighed together.

    Parameters
    ----------
    problem
        What is fitted to what.
    unknowns : (n_unknowns,)
        Where to start; the problem's own start by default.
    tolerance
        A round ends when a step lowers the cost by less than this share.
    rounds
        Rounds at most.
    stands_for
        Readings of the full record that each one of a thinned record stands for, beside priors that stand for themselves.
    deadline
        On the clock of ``time.monotonic``: the search ends there, with what it has.

    Returns
    -------
    Optimum
        Its fit's cost is that of the last round's weights; where the model explains the readings down to their noise,
        the search has ended with the noise alone.
    """
    x = problem.start() if unknowns is None else unknowns
    fit = problem.solve(x)
    best = Optimum(x, fit, np.eye(x.size), "no_solution", 0)
    if not np.isfinite(fit.cost):
        return best
    iterations, before = 0, misfit_K(problem, fit)
    for _ in range(rounds):
        noise = np.hypot(problem.noise_K, CAUTION * before) / np.sqrt(stands_for)
        weighed = replace(problem, noise_K=noise)
        found = minimise(
            weighed,
            x,
            near=fit,
            max_iterations=MAX_ITERATIONS,
            tolerance=tolerance,
            deadline=deadline,
            accelerated=True,
        )
        if found.status == "no_solution":
            break
        best, x, fit, iterations = found, found.unknowns, found.fit, iterations + found.iterations
        after = misfit_K(problem, fit)
        if after > SETTLED * before or best.status == "deadline":
            break
        before = after
    if (CAUTION * misfit_K(problem, fit) < problem.noise_K).all():
        found = minimise(problem, x, near=fit, deadline=deadline, accelerated=True)
        if found.status != "no_solution":
            best, iterations = found, iterations + found.iterations
    return replace(best, iterations=iterations)


def coarse_problem(problem: Problem, step_s: float, n_samples: int | None = None) -> Problem:
    """Return a problem on records thinned to ``n_samples`` at least, with longer steps; itself where records are short.

    By default as many as a first approach needs.
    """
    records = [segment.record for segment in problem.segments]
    if n_samples is None:
        n_samples = int(np.clip(COARSE_READINGS // problem.noise_K.size, LEAST_COARSE, COARSE_SAMPLES))
    stride = sum(r.time_s.size for r in records) // n_samples
    if stride < 2 or min(r.time_s.size for r in records) < 10 * stride:
        return problem
    thin = [thinned(problem.network.spec, record, stride) for record in records]
    coarse = build_problem(problem.network, thin, problem.noise_K, stride * step_s)
    return replace(coarse, huber=problem.huber)


def thinned(spec: TwinSpec, record: Record, stride: int) -> Record:
    """Return one of ``stride`` samples, no channel lost; heat that holds between samples is averaged, so that none is missed."""
    held = {name for name, channel in spec.channels.items() if channel.kind == "power" and channel.is_held}
    read = [np.isfinite(column) for name, column in record.values.items() if name not in held]
    whole = np.all([seen for seen in read if seen.any()] or np.ones((1, record.time_s.size)), axis=0)
    first = one_of_each(whole, stride)
    values = {name: _means(c, first) if name in held else c[first] for name, c in record.values.items()}
    return replace(record, time_s=record.time_s[first], values=values)


def _means(column: FloatArray, first: np.ndarray) -> FloatArray:
    """Return the mean of the finite samples from each of ``first`` up to the next, NaN where there is none."""
    valid: BoolArray = np.isfinite(column)
    counts = np.add.reduceat(valid.astype(np.float64), first)
    sums = np.add.reduceat(np.where(valid, column, 0.0), first)
    return np.where(counts > 0, sums / np.maximum(counts, 1.0), np.nan)
