"""How certain the unknowns of a fit are, in the metric of the noise that the fit was made from."""

from dataclasses import replace

import numpy as np
from numba import njit

from twin_core._typing import FloatArray
from twin_core.calibrate.optimise import Optimum, minimise
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.residual_noise import Whitener, fit_whitener, sensor_jacobians
from twin_core.calibrate.restricted import restricted_noise, told_directions
from twin_core.parameters.vector import ParameterSet

UNTOLD = 1e-13
"""Combinations of unknowns that readings and priors tell less than this share of the best are lost to rounding."""

LITTLE_COST = 0.5 * 1.645**2
"""A likelihood interval of 90 % ends where the cost has risen by this."""


def gls_covariance(problem: Problem, optimum: Optimum, whitener: Whitener) -> FloatArray:
    """Return the covariance of the unknowns, (n_unknowns, n_unknowns), if the coloured residual were all the noise.

    No estimate could be more certain (Gauss and Markov). It is quick, and enough for a search that asks which of many
    models tells its parameters at all.
    """
    _, std = problem.prior()
    hessian = np.diag(1.0 / std**2)
    for sensor, jacobian in sensor_jacobians(problem, optimum):
        whitened = whitener.whiten(sensor, jacobian)
        hessian += whitened.T @ whitened
    directions = told_directions(hessian, UNTOLD)
    return directions @ directions.T


def trajectory_covariance(problem: Problem, optimum: Optimum, whitener: Whitener) -> FloatArray:
    """Return the covariance of the unknowns of a fit to trajectories, (n_unknowns, n_unknowns).

    The fit weighs every reading alike, whatever the colour of the misfit, so that its covariance is
    H⁻¹ (Jᵀ W Σ W J + P) H⁻¹ (Huber 1967): W the weights of the readings, P the priors, H = Jᵀ W J + P, and Σ the noise by
    restricted likelihood. Readings that Huber's loss holds back pull with what it leaves them, and bend nothing.
    """
    _, std = problem.prior()
    limit_K = problem.huber * problem.noise_K
    residuals = [np.clip(residual, -limit_K, limit_K) for residual in problem.residuals(optimum.fit)]
    if np.isfinite(problem.huber):
        whitener = fit_whitener(problem, residuals)
    noise = restricted_noise(problem, optimum, whitener, residuals)
    residual = np.concatenate(residuals)
    turned = told_directions(optimum.hessian, UNTOLD)  # in which nothing is lost to rounding
    hessian = turned.T @ (turned / std[:, None] ** 2)
    spread = hessian.copy()
    for sensor, jacobian in sensor_jacobians(problem, optimum):
        valid = whitener.valid[:, sensor]
        rows = jacobian[valid] @ turned / problem.noise_K[sensor]
        bends = np.abs(residual[valid, sensor]) < limit_K[sensor]
        hessian += rows[bends].T @ rows[bends]
        pull = noise[sensor].white_K2 * rows.T @ rows
        for variance_K2, length_s in noise[sensor].coloured:
            crossed = rows.T @ (0.5 * rows + _faded(whitener.time_s[valid], rows, length_s))
            pull += variance_K2 * (crossed + crossed.T)
        spread += pull / problem.noise_K[sensor] ** 2
    least_squares = np.linalg.solve(hessian, turned.T)
    return np.asarray(least_squares.T @ spread @ least_squares)


def is_open_ended(problem: Problem, optimum: Optimum, position: int) -> bool:
    """Return whether an unknown may as well be larger than its fitted value by all that its prior allows.

    A limit that was never reached has a slope nowhere, and one that cuts off a peak by chance of the noise a slope on one
    side only: down the fit suffers, up it hardly does once the others follow. They are refitted to find out.

    Parameters
    ----------
    problem, optimum
        The fit.
    position
        Of a free parameter that has a prior.
    """
    mean, std = problem.prior()
    here, parameters = float(optimum.unknowns[position]), problem.network.parameters
    limit = parameters.parameters[parameters.free_index[position]]
    held = replace(limit.at(limit.transform.to_value(here + float(std[position]))), frozen=True)
    others = ParameterSet(tuple(held if p is limit else p for p in parameters.parameters))
    network = problem.network.with_parameters(others)
    refitted = minimise(problem.with_network(network), np.delete(optimum.unknowns, position))
    own_cost = 0.5 * ((here - mean[position]) / std[position]) ** 2
    return bool(refitted.fit.cost < optimum.fit.cost - own_cost + LITTLE_COST)


@njit(cache=True)
def _faded(time_s: FloatArray, rows: FloatArray, length_s: float) -> FloatArray:
    """Return for every row the sum of those before it, each times exp(-age / length)."""
    out = np.zeros_like(rows)
    for k in range(1, time_s.size):
        keep = np.exp((time_s[k - 1] - time_s[k]) / length_s)
        for c in range(rows.shape[1]):
            out[k, c] = keep * (out[k - 1, c] + rows[k - 1, c])
    return out
