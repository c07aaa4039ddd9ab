"""How certain the unknowns of a fit are, in the metric of the noise that the fit was made from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from twin_core._typing import FloatArray
from twin_core.calibrate.optimise import Optimum, minimise
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.residual_noise import Whitener, fit_whitener, sensor_jacobians
from twin_core.calibrate.restricted import ExpectedNoise, restricted_noise, told_directions
from twin_core.parameters.vector import ParameterSet

UNTOLD = 1e-13
"""Combinations of unknowns that readings and priors tell less than this share of the best are lost to rounding."""

MOST_TURNED = 4_000_000
"""Derivatives that are turned at once: 32 MB."""

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


def noise_of_fit(problem: Problem, optimum: Optimum, whitener: Whitener) -> list[ExpectedNoise]:
    """Return the noise of each sensor that a fit to trajectories was made from, by restricted likelihood.

    Of readings that Huber's loss holds back counts what it leaves them.
    """
    residuals = _bounded(problem, optimum)
    if np.isfinite(problem.huber):
        whitener = fit_whitener(problem, residuals)
    return restricted_noise(problem, optimum, whitener, residuals)


def _bounded(problem: Problem, optimum: Optimum) -> list[FloatArray]:
    """Return what a fit leaves as far as its loss counts it, (n_samples, n_sensors) per segment."""
    limit_K = problem.huber * problem.noise_K
    return [np.clip(residual, -limit_K, limit_K) for residual in problem.residuals(optimum.fit)]


def trajectory_covariance(
    problem: Problem, optimum: Optimum, whitener: Whitener, noise: Sequence[ExpectedNoise] | None = None
) -> FloatArray:
    """Return the covariance of the unknowns of a fit to trajectories, (n_unknowns, n_unknowns).

    The fit weighs every reading alike, whatever the colour of the misfit, so that its covariance is
    H⁻¹ (Jᵀ W Σ W J + P) H⁻¹ (Huber 1967): W the weights of the readings, P the priors, H = Jᵀ W J + P, and Σ the noise by
    restricted likelihood (``noise_of_fit``, if it is not given). Readings that Huber's loss holds back pull with what it leaves
    them, and bend nothing.
    """
    _, std = problem.prior()
    noise = noise_of_fit(problem, optimum, whitener) if noise is None else noise
    bends = np.abs(np.concatenate(_bounded(problem, optimum))) < problem.huber * problem.noise_K
    turned = told_directions(optimum.hessian, UNTOLD)  # in which nothing is lost to rounding
    hessian = turned.T @ (turned / std[:, None] ** 2)
    spread = hessian.copy()
    first = np.cumsum([0, *(s.record.time_s.size for s in problem.segments)])
    pulls = [_Pull.of(n, turned.shape[1]) for n in noise]
    for segment, samples, block in problem.jacobian_stretches(optimum.unknowns, optimum.fit):
        if block.shape[0] == 0:  # a stretch within a long gap
            continue
        at = slice(int(first[segment]) + samples.start, int(first[segment]) + samples.stop)
        columns = turned[np.r_[0 : problem.n_free, problem.start_columns(segment)]]
        together = max(1, MOST_TURNED // (block.shape[0] * columns.shape[1]))
        for begin in range(0, len(pulls), together):
            sensors = slice(begin, min(begin + together, len(pulls)))
            weight = (whitener.valid[at, sensors] / problem.noise_K[sensors]).T[:, :, None]
            rows = (block[:, sensors].transpose(1, 0, 2) @ columns) * weight
            pulled = np.array([p.along(whitener.time_s[at], r) for p, r in zip(pulls[sensors], rows, strict=True)])
            pulled /= problem.noise_K[sensors, None, None] ** 2
            crossed = rows.reshape(-1, rows.shape[2]).T @ pulled.reshape(-1, rows.shape[2])
            spread += crossed + crossed.T
            rows *= bends[at, sensors].T[:, :, None]
            flat = rows.reshape(-1, rows.shape[2])
            hessian += flat.T @ flat
    least_squares = np.linalg.solve(hessian, turned.T)
    return np.asarray(least_squares.T @ spread @ least_squares)


@dataclass
class _Pull:
    """What the noise of one sensor makes of its derivatives along the record, which comes in stretches.

    Attributes
    ----------
    white_K2
        Half the variance of one reading.
    variance_K2, length_s : (n_coloured,)
    carried : (n_coloured, n_columns)
        The sum of all rows so far, each faded by its age.
    last_s
        The last row's time.
    """

    white_K2: float
    variance_K2: FloatArray
    length_s: FloatArray
    carried: FloatArray
    last_s: float = -np.inf

    @classmethod
    def of(cls, noise: ExpectedNoise, n_columns: int) -> "_Pull":
        """Begin a record."""
        variance_K2, length_s = np.array(noise.coloured).reshape(-1, 2).T
        white_K2 = 0.5 * (noise.white_K2 + float(variance_K2.sum()))
        return cls(white_K2, variance_K2.copy(), length_s.copy(), np.zeros((length_s.size, n_columns)))

    def along(self, time_s: FloatArray, rows: FloatArray) -> FloatArray:
        """Return Y of the next rows (n_rows, n_columns) of X such that Xᵀ Σ X = Xᵀ Y + Yᵀ X; a missing reading's is zero."""
        out = self.white_K2 * rows
        _add_faded(time_s, rows, self.variance_K2, self.length_s, self.last_s, self.carried, out)
        self.last_s = float(time_s[-1])
        return out


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
def _add_faded(
    time_s: FloatArray,
    rows: FloatArray,
    variance: FloatArray,
    length_s: FloatArray,
    last_s: float,
    carried: FloatArray,
    out: FloatArray,
) -> None:
    """Add to every row those before it, each times variance exp(-age / length) of every coloured part."""
    for part in range(length_s.size):
        before_s = last_s
        for k in range(time_s.size):
            keep = np.exp((before_s - time_s[k]) / length_s[part])
            for c in range(rows.shape[1]):
                faded = keep * carried[part, c]
                out[k, c] += variance[part] * faded
                carried[part, c] = faded + rows[k, c]
            before_s = time_s[k]
