"""What a calibration misses on parts of a record that it is not fitted to: blocks, the end, and whole sessions."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.calibrate.optimise import minimise
from twin_core.calibrate.problem import Segment
from twin_core.calibrate.residual_noise import stacked_jacobian
from twin_core.calibrate.second_order import Calibration

N_BLOCKS = 8
"""Blocks of the training record that are predicted from the others."""

FORWARD_SHARE = 0.35
"""End of a single segment that is predicted from its beginning."""

OPENING_SHARE = 0.1
"""First samples of a segment, which tell its initial state, and are left out by no check."""

MOST_FOLDS = 4
"""Groups of segments that are left out in turn."""


def blocked_errors(calibration: Calibration) -> FloatArray:
    """Return the error on each of ``N_BLOCKS`` blocks of the record, predicted by parameters fitted to the others.

    At the optimum with Hessian H, leaving out block b moves the parameters by -(H - J_b' J_b)^-1 J_b' r_b, so that the
    residual on b becomes r_b + J_b (H - J_b' J_b)^-1 J_b' r_b: exact for a linear model, no refit needed.
    """
    problem, unknowns = calibration.problem, calibration.optimum.unknowns
    jacobian = stacked_jacobian(problem, problem.jacobian_blocks(unknowns, calibration.optimum.fit))
    residual = np.concatenate(calibration.residuals) / problem.noise_K
    jacobian = jacobian / problem.noise_K[None, :, None]
    hessian = calibration.optimum.hessian
    told = np.isinf(
        problem.step_bounds(unknowns)[1]
    )  # an instant is told by one block alone, and seldom moves linearly
    jacobian, hessian = jacobian[:, :, told], hessian[np.ix_(told, told)]
    later = np.concatenate([~_opening(segment) for segment in problem.segments])
    edges = np.linspace(0, residual.shape[0], N_BLOCKS + 1).astype(int)
    errors = np.zeros(N_BLOCKS)
    for b, (first, last) in enumerate(pairwise(edges.tolist())):
        valid = np.isfinite(residual[first:last]) & later[first:last]
        rows, left = jacobian[first:last][valid], residual[first:last][valid]
        rest = hessian - rows.T @ rows
        scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
        inverse = np.linalg.pinv(rest * scale[:, None] * scale, rcond=1e-10, hermitian=True)
        move = scale * (inverse @ (scale * (rows.T @ left)))
        predicted = left + rows @ move
        errors[b] = float(predicted @ predicted)
    return errors


def forward_error(calibration: Calibration) -> float:
    """Return the open-loop error over what a refit has not seen; infinite where a refit fails.

    Segments are sessions: each is predicted by a fit to the others, because what changes between sessions is no physics.
    Of a single one the end is predicted by a fit to the beginning.
    """
    problem, optimum = calibration.problem, calibration.optimum
    error = 0.0
    for fold in _folds(problem.segments):
        kept = tuple(
            replace(segment, measured_K=np.where(out, np.nan, segment.measured_K))
            for segment, out in zip(problem.segments, fold, strict=True)
        )
        refit = minimise(replace(problem, segments=kept), optimum.unknowns, near=optimum.fit)
        if refit.status == "no_solution":
            return np.inf
        for segment, out, predicted_K in zip(problem.segments, fold, refit.fit.predicted_K, strict=True):
            left = (segment.measured_K - predicted_K) / problem.noise_K
            error += float(np.nansum(np.where(out, left, 0.0) ** 2))
    return error


def _folds(segments: Sequence[Segment]) -> list[list[BoolArray]]:
    """Return what is left out in turn: per fold and segment which rows, (n_samples, 1)."""
    if len(segments) == 1:
        n_rows = segments[0].measured_K.shape[0]
        return [[np.arange(n_rows)[:, None] >= int((1.0 - FORWARD_SHARE) * n_rows)]]
    n_folds = min(len(segments), MOST_FOLDS)
    return [
        [~_opening(segment) & (i % n_folds == fold) for i, segment in enumerate(segments)] for fold in range(n_folds)
    ]


def _opening(segment: Segment) -> BoolArray:
    """Return which rows of a segment tell its initial state, (n_samples, 1)."""
    n_rows = segment.measured_K.shape[0]
    return np.arange(n_rows)[:, None] < max(int(OPENING_SHARE * n_rows), 3)
