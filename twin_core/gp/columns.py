"""Many responses through one filter: the regression that hides in a Kalman filter.

Innovations are linear in the samples and in the offsets b. If y = y₀ + sum_j w_j (response to offsets b_j), then

    e(y, b₀ + sum_j w_j b_j) = e(y, b₀) + sum_j w_j e(0, b_j),

with one set of gains for all. Divided by sqrt(S) this is an ordinary least-squares problem in w whose noise is white:
generalised least squares under the model's full covariance, in time linear in the samples. De Jong, *The diffuse Kalman
filter* (1991); here without the diffuse part.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.gp.kalman import LOG_2PI, failure, project, update
from twin_core.gp.linalg import alike, congruence
from twin_core.gp.state_space import LinearModel, ModelArrays


@dataclass(frozen=True)
class WhiteRegression:
    """Least squares: target = columns @ weights + white noise of unit variance.

    Attributes
    ----------
    target : (n_rows,)
        One row per sample that was seen, in order of time and sensor.
    columns : (n_rows, n_columns)
    log_likelihood
        ln p(y) at weights of zero.
    """

    target: FloatArray
    columns: FloatArray
    log_likelihood: float


@njit(cache=True)
def _advance(a: FloatArray, offset: FloatArray, offsets: FloatArray, k: int, means: FloatArray) -> None:
    """Advance the mean of the samples (first row) and of every column; the columns start from zero."""
    n = a.shape[0]
    fresh = np.empty(n)
    for c in range(means.shape[0]):
        for i in range(n):
            total = offset[k, i] if c == 0 else offsets[c - 1, k, i]
            for j in range(n):
                if a[i, j] != 0.0:
                    total += a[i, j] * means[c, j]
            fresh[i] = total
        means[c] = fresh


@njit(cache=True)
def _run(
    model: ModelArrays, y: FloatArray, offsets: FloatArray, tolerance: float, out: FloatArray
) -> tuple[float, int]:
    """Fill ``out`` (n_rows, 1 + n_columns); return the log-likelihood and the step that failed, or -1."""
    n_times, m, n = y.shape[0], y.shape[1], model.prior_mean.size
    means = np.zeros((offsets.shape[0] + 1, n))
    means[0] = model.prior_mean
    cov, before, work, turned = model.prior_cov.copy(), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    gains, variances, scratch = np.zeros((m, n)), np.ones(m), np.empty(n)
    steady, repeats, total, row_out = False, False, 0.0, 0
    for k in range(n_times):
        if k > 0:
            d = model.step_index[k - 1]
            repeats = k > 1 and model.step_index[k - 2] == d
            for s in range(m):
                repeats = repeats and np.isnan(y[k, s]) == np.isnan(y[k - 1, s])
            steady = steady and repeats
            _advance(model.transition[d], model.offset, offsets, k - 1, means)
            if not steady:
                before[:] = cov
                congruence(model.transition[d], before, work, turned, cov)
                for i in range(n):
                    for j in range(n):
                        cov[i, j] += model.process_cov[d, i, j]
        for s in range(m):
            if np.isnan(y[k, s]):
                continue
            row = model.observation[s]
            if not steady:
                variances[s] = update(cov, row, model.noise_variance[s], gains[s], scratch)
                if variances[s] < 0.0:
                    return total, k
            scale = 1.0 / np.sqrt(variances[s])
            for c in range(means.shape[0]):
                surprise = -project(row, means[c]) if c > 0 else y[k, s] - project(row, means[c])
                out[row_out, c] = surprise * scale
                for i in range(n):
                    means[c, i] += gains[s, i] * surprise
            total -= 0.5 * (LOG_2PI + np.log(variances[s]) + out[row_out, 0] ** 2)
            row_out += 1
        if repeats and not steady:
            steady = alike(cov, before, tolerance)
    return total, -1


def whiten_responses(
    model: LinearModel, observations: FloatArray, offsets: FloatArray, *, settle_tolerance: float = 1e-13
) -> WhiteRegression:
    """Return samples and responses as a white least-squares problem.

    Parameters
    ----------
    model
        Everything but the columns.
    observations : (n_times, n_sensors)
        NaN where missing.
    offsets : (n_columns, n_steps, n_states)
        What a weight of one adds to the model's offset.
    settle_tolerance
        As in :func:`twin_core.gp.kalman.kalman_filter`.

    Raises
    ------
    ModelError
        A shape is wrong, or a sample without noise contradicts what is known exactly.
    """
    y = model.observed(observations)
    columns = np.ascontiguousarray(offsets, dtype=np.float64)
    if columns.ndim != 3 or columns.shape[1:] != model.offset.shape:
        raise ModelError(f"offsets have shape {columns.shape}, they must be (n_columns, *{model.offset.shape})")
    out = np.zeros((int(np.isfinite(y).sum()), columns.shape[0] + 1))
    total, failed = _run(model.arrays, y, columns, float(settle_tolerance), out)
    if failed >= 0:
        raise failure(model, failed)
    return WhiteRegression(out[:, 0].copy(), -out[:, 1:], total)
