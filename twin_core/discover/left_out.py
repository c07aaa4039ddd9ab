"""What a calibration misses on parts of a record that it is not fitted to: blocks, the end, and whole sessions."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.calibrate.optimise import Optimum, minimise
from twin_core.calibrate.problem import Fit, Problem, Segment
from twin_core.calibrate.residual_noise import stacked_jacobian
from twin_core.calibrate.second_order import Calibration, sampling_step_s

N_BLOCKS = 8
"""Blocks of the training record that are predicted from the others."""

MISJUDGED = 0.02
"""Share of the error on all blocks by which that on one may be misjudged, or it is refitted: the ratio of two such errors (rms)
is right to a percent then. A limit of accuracy, not of belief."""

FORWARD_SHARE = 0.35
"""End of a single segment that is predicted from its beginning."""

OPENING_SHARE = 0.1
"""First samples of a segment, which tell its initial state, and those after an event, which tell its size, of the latter no more
than half of what follows: left out by no check of what follows."""

MOST_FOLDS = 4
"""Groups of segments that are left out in turn."""


def blocked_errors(calibration: Calibration) -> FloatArray:
    """Return the error on each of ``N_BLOCKS`` blocks of the record, predicted by parameters fitted to the others.

    Returns
    -------
    (2, N_BLOCKS)
        By fits beside the sensors' own noise, and beside the noise that lasts, as :func:`forward_error`.
    """
    problem, optimum = calibration.problem, calibration.optimum
    jacobian = stacked_jacobian(problem, problem.jacobian_blocks(optimum.unknowns, optimum.fit))
    return np.array([_blocked_errors(calibration, jacobian, noise_K) for noise_K in _noises_K(calibration)])


def _blocked_errors(calibration: Calibration, jacobian: FloatArray, noise_K: FloatArray) -> FloatArray:
    """Return the error on each block beside a noise.

    At the optimum with Hessian H, leaving out block b moves the parameters by -(H - J_b' J_b)^-1 J_b' r_b, so that the
    residual on b becomes r_b + J_b (H - J_b' J_b)^-1 J_b' r_b: exact for a linear model, no refit needed. Where one block alone
    tells a parameter, it moves far: what the model predicts there is asked, and a refit where that is something else. Beside
    another noise than that of the fit its optimum stands for the one there.
    """
    problem, unknowns = calibration.problem, calibration.optimum.unknowns
    jacobian = jacobian / noise_K[:, None]
    residual = np.concatenate(calibration.residuals) / noise_K
    in_own_noise = np.broadcast_to(noise_K / problem.noise_K, residual.shape)
    told_by = jacobian[np.isfinite(residual)]
    hessian = told_by.T @ told_by + np.diag(problem.prior()[1] ** -2.0)
    down, up = problem.step_bounds(unknowns)
    told = (down < 0.0) & (up > 0.0)  # what rests on a bound stays there
    # An instant is told by one block alone, and seldom moves linearly.
    told[: problem.n_free] &= np.isinf(problem.network.parameters.step_limits)
    jacobian, hessian = jacobian[:, :, told], hessian[np.ix_(told, told)]
    later = np.concatenate([~_opening(segment) for segment in problem.segments])
    edges = np.linspace(0, residual.shape[0], N_BLOCKS + 1).astype(int)
    errors, moves = np.zeros(N_BLOCKS), np.zeros((N_BLOCKS, unknowns.size))
    for b, (first, last) in enumerate(pairwise(edges.tolist())):
        valid = np.isfinite(residual[first:last]) & later[first:last]
        rows, left = jacobian[first:last][valid], residual[first:last][valid]
        rest = hessian - rows.T @ rows
        scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
        inverse = np.linalg.pinv(rest * scale[:, None] * scale, rcond=1e-10, hermitian=True)
        move = scale * (inverse @ (scale * (rows.T @ left)))
        predicted = (left + rows @ move) * in_own_noise[first:last][valid]
        errors[b] = float(predicted @ predicted)
        moves[b, told] = -move
    if not told.all():
        return errors
    enough = MISJUDGED * errors.sum()
    for b, (first, last) in enumerate(pairwise(edges.tolist())):
        out = np.zeros(later.shape, dtype=bool)
        out[first:last] = later[first:last]
        there = _error(problem, problem.solve(unknowns + moves[b], calibration.optimum.fit), out)
        if not abs(there - errors[b]) <= enough:
            refitted = _error(problem, _refitted(calibration, noise_K, out).fit, out)
            errors[b] = refitted if np.isfinite(refitted) else errors[b]
    return errors


def _refitted(calibration: Calibration, noise_K: FloatArray, out: BoolArray) -> Optimum:
    """Return a refit beside a noise to all but some rows (n_rows, 1) of all segments."""
    problem, optimum = calibration.problem, calibration.optimum
    edges = np.cumsum([segment.measured_K.shape[0] for segment in problem.segments])[:-1]
    kept = tuple(
        replace(segment, measured_K=np.where(rows, np.nan, segment.measured_K))
        for segment, rows in zip(problem.segments, np.split(out, edges), strict=True)
    )
    return minimise(replace(problem, segments=kept, noise_K=noise_K), optimum.unknowns, near=optimum.fit)


def _noises_K(calibration: Calibration) -> tuple[FloatArray, FloatArray]:
    """Return each sensor's own noise, and no less than it what its residual amounts to in the long run, (n_sensors,) both.

    A coarse model leaves a misfit that lasts. Counted sample by sample, readings seem to tell what they do not, and a refit to a
    part of them may follow a misfit that wanders; by the noise that lasts it falls back on guesses where they tell little.
    """
    problem, whitener = calibration.problem, calibration.whitener
    interval_s = sampling_step_s([segment.record for segment in problem.segments])
    n_valid = whitener.valid.sum(axis=0).tolist()
    lasting = [model.lasting(interval_s, n) for model, n in zip(whitener.models, n_valid, strict=True)]
    return problem.noise_K, np.maximum(problem.noise_K, lasting)


def _error(problem: Problem, fit: Fit, out: BoolArray) -> float:
    """Return the sum of squared weighted errors of a fit on rows (n_rows, 1) of all segments; infinite without a solution."""
    if not np.isfinite(fit.cost):
        return np.inf
    measured_K = np.concatenate([segment.measured_K for segment in problem.segments])
    left = (measured_K - np.concatenate(fit.predicted_K)) / problem.noise_K
    return float(np.nansum(np.where(out, left, 0.0) ** 2))


def forward_error(calibration: Calibration, event_s: float = -np.inf) -> FloatArray:
    """Return the open-loop error over what a refit has not seen; infinite where a refit fails, zero where nothing is left.

    Segments are sessions: each is predicted by a fit to the others, because what changes between sessions is no physics.
    Of a single one the end is predicted by a fit to the beginning, up to a while after ``event_s`` on the clock of
    ``Record.clock_s``: nothing foretells an event that has not begun.

    Returns
    -------
    (2,)
        Mean square of the readings, each in units of its noise, by refits beside the sensors' own noise, and beside the noise
        that lasts.
    """
    problem = calibration.problem
    folds = [np.concatenate(fold) for fold in _folds(problem.segments, event_s)]
    seen = np.isfinite(np.concatenate([segment.measured_K for segment in problem.segments]))
    n_readings = max(sum(int((seen & fold).sum()) for fold in folds), 1)
    return np.array(
        [
            sum(_error(problem, _refitted(calibration, noise_K, fold).fit, fold) for fold in folds if fold.any())
            / n_readings
            for noise_K in _noises_K(calibration)
        ]
    )


def _folds(segments: Sequence[Segment], event_s: float) -> list[list[BoolArray]]:
    """Return what is left out in turn: per fold and segment which rows, (n_samples, 1)."""
    if len(segments) == 1:
        (segment,) = segments
        n_rows = segment.measured_K.shape[0]
        event = int(np.searchsorted(segment.record.clock_s, event_s))
        told = event + min(OPENING_SHARE * n_rows, (n_rows - event) / 2.0)
        return [[np.arange(n_rows)[:, None] >= int(max((1.0 - FORWARD_SHARE) * n_rows, told))]]
    n_folds = min(len(segments), MOST_FOLDS)
    return [
        [~_opening(segment) & (i % n_folds == fold) for i, segment in enumerate(segments)] for fold in range(n_folds)
    ]


def _opening(segment: Segment) -> BoolArray:
    """Return which rows of a segment tell its initial state, (n_samples, 1)."""
    n_rows = segment.measured_K.shape[0]
    return np.arange(n_rows)[:, None] < max(int(OPENING_SHARE * n_rows), 3)
