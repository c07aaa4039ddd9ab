"""Log-likelihood of a linear model with its exact gradient, by differentiating the filter forwards.

With S, K and ν of one scalar sample and dots for the derivative in one parameter, the Joseph form gives

    d P⁺ = (I - K h) dP (I - K h)ᵀ + dr K Kᵀ        (the gain is optimal: its own derivative does not enter)
    d ln p = -½ dS / S + ½ ν² dS / S² - ν dν / S

and sum(dν dνᵀ / S + ½ dS dSᵀ / S²), whose expectation is the Fisher information, comes at no further cost.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.gp.kalman import LOG_2PI, failure, project, update
from twin_core.gp.linalg import alike, congruence, multiply, symmetrise, transpose
from twin_core.gp.state_space import LinearModel, ModelArrays

SETTLED = 1e-12
"""Relative change per step of covariance and derivatives below which both are taken as constant."""


class Slopes(NamedTuple):
    """Derivatives of a model's arrays in n_free parameters.

    Attributes
    ----------
    transition, process_cov : (n_free, n_distinct, n, n)
    offset : (n_free, n_steps, n)
    noise_variance : (n_free, n_sensors)
    prior_mean : (n_free, n)
    prior_cov : (n_free, n, n)
    """

    transition: FloatArray
    process_cov: FloatArray
    offset: FloatArray
    noise_variance: FloatArray
    prior_mean: FloatArray
    prior_cov: FloatArray


@dataclass(frozen=True)
class Score:
    """Log-likelihood with derivatives.

    Attributes
    ----------
    log_likelihood
        ln p(y).
    gradient : (n_free,)
    information : (n_free, n_free)
        Positive semidefinite; its expectation over data is the Fisher information.
    """

    log_likelihood: float
    gradient: FloatArray
    information: FloatArray


class _State(NamedTuple):
    """What is carried from sample to sample, and what is reused once it has settled."""

    mean: FloatArray
    cov: FloatArray
    d_mean: FloatArray
    d_cov: FloatArray
    gains: FloatArray
    variances: FloatArray
    d_gains: FloatArray
    d_variances: FloatArray


@njit(cache=True)
def _predict_mean(a: FloatArray, b: FloatArray, da: FloatArray, db: FloatArray, s: _State) -> None:
    n = s.mean.size
    fresh = np.empty(n)
    for p in range(s.d_mean.shape[0]):
        for i in range(n):
            total = db[p, i]
            for j in range(n):
                total += da[p, i, j] * s.mean[j] + a[i, j] * s.d_mean[p, j]
            fresh[i] = total
        s.d_mean[p] = fresh
    for i in range(n):
        total = b[i]
        for j in range(n):
            total += a[i, j] * s.mean[j]
        fresh[i] = total
    s.mean[:] = fresh


@njit(cache=True)
def _predict_cov(
    a: FloatArray, q: FloatArray, da: FloatArray, dq: FloatArray, s: _State, work: FloatArray, turned: FloatArray
) -> None:
    """dP <- dA P Aᵀ + (dA P Aᵀ)ᵀ + A dP Aᵀ + dQ, then P <- A P Aᵀ + Q."""
    n = s.mean.size
    forward, crossed = np.empty((n, n)), np.empty((n, n))
    transpose(a, turned)
    multiply(s.cov, turned, forward)
    for p in range(s.d_mean.shape[0]):
        multiply(da[p], forward, crossed)
        multiply(a, s.d_cov[p], work)
        multiply(work, turned, s.d_cov[p])
        for i in range(n):
            for j in range(n):
                s.d_cov[p, i, j] += crossed[i, j] + crossed[j, i] + dq[p, i, j]
        symmetrise(s.d_cov[p])
    congruence(a, s.cov.copy(), work, turned, s.cov)
    for i in range(n):
        for j in range(n):
            s.cov[i, j] += q[i, j]


@njit(cache=True)
def _differentiate_gain(k: int, row: FloatArray, dr: FloatArray, s: _State) -> None:
    """Fill the derivatives of S and K of sensor ``k`` and carry dP through the update."""
    n = s.mean.size
    gain = s.gains[k]
    left = np.empty(n)
    for p in range(s.d_mean.shape[0]):
        d_cov = s.d_cov[p]
        for i in range(n):
            left[i] = project(row, d_cov[i])
        slope = project(row, left) + dr[p]
        s.d_variances[p, k] = slope
        for i in range(n):
            s.d_gains[p, k, i] = (left[i] - gain[i] * slope) / s.variances[k]
        for i in range(n):
            for j in range(n):
                d_cov[i, j] += gain[i] * slope * gain[j] - gain[i] * left[j] - left[i] * gain[j]


@njit(cache=True)
def _use_sample(
    k: int, y: float, row: FloatArray, s: _State, gradient: FloatArray, information: FloatArray, d_nu: FloatArray
) -> float:
    """Carry the means through one scalar sample; add to gradient and information; return ln p of the sample."""
    n, n_free = s.mean.size, gradient.size
    nu, variance = y - project(row, s.mean), s.variances[k]
    weighted = nu / variance
    for p in range(n_free):
        d_nu[p] = -project(row, s.d_mean[p])
        slope = s.d_variances[p, k]
        gradient[p] += 0.5 * slope * (weighted * weighted - 1.0 / variance) - weighted * d_nu[p]
        for i in range(n):
            s.d_mean[p, i] += s.d_gains[p, k, i] * nu + s.gains[k, i] * d_nu[p]
    for p in range(n_free):
        for o in range(n_free):
            squares = 0.5 * s.d_variances[p, k] * s.d_variances[o, k] / variance
            information[p, o] += (d_nu[p] * d_nu[o] + squares) / variance
    for i in range(n):
        s.mean[i] += s.gains[k, i] * nu
    return -0.5 * (LOG_2PI + np.log(variance) + nu * weighted)


@njit(cache=True)
def _settles(s: _State, before: FloatArray, d_before: FloatArray, tolerance: float) -> bool:
    """Return whether P and every dP repeat; dP is measured against P, as parameters are logarithms."""
    if not alike(s.cov, before, tolerance):
        return False
    for p in range(s.d_cov.shape[0]):
        for i in range(before.shape[0]):
            for j in range(i + 1):
                change = s.d_cov[p, i, j] - d_before[p, i, j]
                if change * change > tolerance * tolerance * s.cov[i, i] * s.cov[j, j]:
                    return False
    return True


@njit(cache=True)
def _run(
    model: ModelArrays, slopes: Slopes, y: FloatArray, tolerance: float, gradient: FloatArray, information: FloatArray
) -> tuple[float, int]:
    """Return the log-likelihood and the step that failed, or -1; fill gradient and information."""
    n_times, m, n, n_free = y.shape[0], y.shape[1], model.prior_mean.size, gradient.size
    s = _State(
        model.prior_mean.copy(), model.prior_cov.copy(), slopes.prior_mean.copy(), slopes.prior_cov.copy(),
        np.zeros((m, n)), np.ones(m), np.zeros((n_free, m, n)), np.zeros((n_free, m)),
    )  # fmt: skip
    before, d_before = np.empty((n, n)), np.empty((n_free, n, n))
    work, turned, scratch, d_nu = np.empty((n, n)), np.empty((n, n)), np.empty(n), np.empty(n_free)
    steady, repeats, total = False, False, 0.0
    for k in range(n_times):
        if k > 0:
            d = model.step_index[k - 1]
            repeats = k > 1 and model.step_index[k - 2] == d
            for i in range(m):
                repeats = repeats and np.isnan(y[k, i]) == np.isnan(y[k - 1, i])
            steady = steady and repeats
            a, da = model.transition[d], slopes.transition[:, d]
            _predict_mean(a, model.offset[k - 1], da, slopes.offset[:, k - 1], s)
            if not steady:
                before[:] = s.cov
                d_before[:] = s.d_cov
                _predict_cov(a, model.process_cov[d], da, slopes.process_cov[:, d], s, work, turned)
        for i in range(m):
            if np.isnan(y[k, i]):
                continue
            row = model.observation[i]
            if not steady:
                s.variances[i] = update(s.cov, row, model.noise_variance[i], s.gains[i], scratch)
                if s.variances[i] < 0.0:
                    return total, k
                _differentiate_gain(i, row, slopes.noise_variance[:, i], s)
            total += _use_sample(i, y[k, i], row, s, gradient, information, d_nu)
        if repeats and not steady:
            steady = _settles(s, before, d_before, tolerance)
    return total, -1


def score(model: LinearModel, slopes: Slopes, observations: FloatArray, *, settle_tolerance: float = SETTLED) -> Score:
    """Return log-likelihood, gradient and information.

    Parameters
    ----------
    model
        The model at the present parameters.
    slopes
        Derivatives of its arrays, preferably in logarithms of positive parameters.
    observations : (n_times, n_sensors)
        NaN where missing.
    settle_tolerance
        Negative: never reuse gains.

    Raises
    ------
    ModelError
        A shape is wrong, or a sample without noise contradicts what is known exactly.
    """
    y = model.observed(observations)
    n_free = slopes.prior_mean.shape[0]
    for name in Slopes._fields:
        expected = (n_free, *getattr(model, name).shape)
        if getattr(slopes, name).shape != expected:
            raise ModelError(f"slopes of {name} have shape {getattr(slopes, name).shape}, they must have {expected}")
    gradient, information = np.zeros(n_free), np.zeros((n_free, n_free))
    arrays = Slopes(*(np.ascontiguousarray(a, dtype=np.float64) for a in slopes))
    total, failed = _run(model.arrays, arrays, y, float(settle_tolerance), gradient, information)
    if failed >= 0:
        raise failure(model, failed)
    return Score(total, gradient, information)
