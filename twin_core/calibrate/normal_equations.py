"""The normal equations of a problem at one point, and what a step over curved ground needs beyond them."""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.calibrate.containment import check_time
from twin_core.calibrate.problem import Fit, Problem

MOST_KEPT = 4_000_000
"""Derivatives that are kept at most (32 MB): a longer record does without the second-order correction."""


@dataclass(frozen=True)
class Slopes:
    """Weighted derivatives of some readings.

    Attributes
    ----------
    segment, samples
        Which readings.
    columns : (n_columns,)
        Positions of the unknowns that move them.
    weight : (n_samples, n_sensors)
        One over the noise; zero where a reading is missing, less where it counts linearly.
    rows : (n_samples * n_sensors, n_columns)
        Derivatives times weight.
    """

    segment: int
    samples: slice
    columns: IntArray
    weight: FloatArray
    rows: FloatArray


@dataclass(frozen=True)
class NormalEquations:
    """Second-order model of the cost at one point.

    Attributes
    ----------
    hessian : (n_unknowns, n_unknowns)
        Of Gauss and Newton.
    gradient : (n_unknowns,)
    slopes
        What they were made of; empty for a record that is too long to keep it.
    """

    hessian: FloatArray
    gradient: FloatArray
    slopes: tuple[Slopes, ...]

    def curvature(self, fit: Fit, moved: Fit, step: FloatArray) -> FloatArray:
        """Return J'W times what a step has changed of the readings beyond its linear response, (n_unknowns,).

        Half the second directional derivative of the residuals, to leading order.

        Parameters
        ----------
        fit, moved
            The model here and a step further.
        step : (n_unknowns,)
        """
        bent = np.zeros(step.size)
        for part in self.slopes:
            change_K = moved.predicted_K[part.segment][part.samples] - fit.predicted_K[part.segment][part.samples]
            beyond = (part.weight * change_K).ravel() - part.rows @ step[part.columns]
            bent[part.columns] += part.rows.T @ beyond
        return bent


def normal_equations(problem: Problem, unknowns: FloatArray, fit: Fit) -> NormalEquations:
    """Return the normal equations of a problem.

    Parameters
    ----------
    problem
        What is fitted to what.
    unknowns : (n_unknowns,)
    fit
        The model there.

    Raises
    ------
    ArithmeticError
        Where the sensitivities have overflowed.
    """
    mean, std = problem.prior()
    hessian = np.diag(1.0 / std**2)
    gradient = (unknowns - mean) / std**2
    residuals = problem.residuals(fit)
    n_columns = problem.n_free + problem.n_nodes
    keep = sum(r.size for r in residuals) * n_columns <= MOST_KEPT
    slopes = []
    for i, samples, block in problem.jacobian_stretches(unknowns, fit):
        check_time()  # one evaluation over a long record takes seconds
        residual = residuals[i][samples]
        valid = np.isfinite(residual)
        scaled = np.where(valid, residual, 0.0) / problem.noise_K
        weight = valid / problem.noise_K
        if np.isfinite(problem.huber):  # iteratively reweighted least squares
            shrunk = np.sqrt(np.minimum(1.0, problem.huber / np.maximum(np.abs(scaled), 1e-12)))
            scaled, weight = scaled * shrunk, weight * shrunk
        block *= weight[:, :, None]
        rows = block.reshape(-1, n_columns)
        columns = np.r_[0 : problem.n_free, problem.start_columns(i)]
        hessian[np.ix_(columns, columns)] += rows.T @ rows
        gradient[columns] -= rows.T @ scaled.ravel()
        if keep:
            slopes.append(Slopes(i, samples, columns, weight, rows))
    if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
        raise ArithmeticError("the sensitivities are not finite")
    return NormalEquations(hessian, gradient, tuple(slopes))
