"""A compiled filter that whitens many columns at once in the metric of sensor noise plus undeclared heat.

The network carries an Ornstein-Uhlenbeck heat on every node. Readings, sensitivities and candidate responses all pass
through the one filter that this implies; its innovations are white, so that plain least squares on them is generalised
least squares on the readings (Särkkä and Svensson 2023, section 12.3).
"""

import numpy as np
from numba import njit

from twin_core._typing import BoolArray, FloatArray, IntArray


@njit(cache=True, fastmath=True)
def whiten_columns(
    transition: FloatArray,
    response: FloatArray,
    keep: FloatArray,
    force_variance: FloatArray,
    state_variance: FloatArray,
    observed: IntArray,
    noise_variance: FloatArray,
    start_variance: FloatArray,
    sample_of: IntArray,
    valid: BoolArray,
    columns: FloatArray,
) -> tuple[FloatArray, float]:
    """Pass columns of readings through the filter.

    Parameters
    ----------
    transition, response : (n_steps, n, n)
        d end / d start, and d end / d heat held over the step.
    keep : (n_steps,)
        exp(-h / length) of the heat.
    force_variance : (n,)
        Stationary variance of the heat on each node, W^2.
    state_variance : (n,)
        Variance that each step adds to each state, K^2: a floor that keeps the filter awake.
    observed : (n_sensors,)
        State that each sensor reads.
    noise_variance : (n_sensors,)
    start_variance : (n,)
        Prior variance of the initial temperatures.
    sample_of : (n_steps + 1,)
        Row of ``columns`` at each point of the grid, -1 where there is no sample.
    valid : (n_samples, n_sensors)
    columns : (n_samples, n_sensors, n_columns)

    Returns
    -------
    (n_samples, n_sensors, n_columns), float
        Innovations over their standard deviation, zero where invalid; ln det of the covariance of the readings.
    """
    n_steps, n = transition.shape[0], transition.shape[1]
    n_columns, n_sensors = columns.shape[2], observed.size
    out = np.zeros_like(columns)
    both = 2 * n
    cov = np.zeros((both, both))
    for i in range(n):
        cov[i, i] = start_variance[i]
        cov[n + i, n + i] = force_variance[i]
    mean = np.zeros((both, n_columns))
    work = np.empty((both, n_columns))
    full = np.zeros((both, both))
    turned = np.empty((both, both))
    gain = np.empty(both)
    log_det = 0.0
    for k in range(n_steps + 1):
        if k > 0:
            for i in range(n):
                for j in range(n):
                    full[i, j] = transition[k - 1, i, j]
                    full[i, n + j] = response[k - 1, i, j]
                full[n + i, n + i] = keep[k - 1]
            for i in range(n):
                for j in range(both):
                    total = 0.0
                    for m in range(both):
                        total += full[i, m] * cov[m, j]
                    turned[i, j] = total
            for i in range(n):
                for j in range(both):
                    turned[n + i, j] = keep[k - 1] * cov[n + i, j]
            for i in range(both):
                for j in range(i + 1):
                    total = 0.0
                    if j < n:
                        for m in range(both):
                            total += turned[i, m] * full[j, m]
                    else:
                        total = turned[i, j] * keep[k - 1]
                    cov[i, j] = total
                    cov[j, i] = total
            for i in range(n):
                cov[i, i] += state_variance[i]
                cov[n + i, n + i] += force_variance[i] * (1.0 - keep[k - 1] * keep[k - 1])
            for i in range(n):
                for c in range(n_columns):
                    work[i, c] = 0.0
                for j in range(both):
                    factor = full[i, j]
                    if factor != 0.0:
                        for c in range(n_columns):
                            work[i, c] += factor * mean[j, c]
            for i in range(n):
                for c in range(n_columns):
                    mean[i, c] = work[i, c]
                    mean[n + i, c] *= keep[k - 1]
        row = sample_of[k]
        if row < 0:
            continue
        for s in range(n_sensors):
            if not valid[row, s]:
                continue
            o = observed[s]
            variance = cov[o, o] + noise_variance[s]
            root = np.sqrt(variance)
            log_det += np.log(variance)
            for i in range(both):
                gain[i] = cov[i, o] / variance
            for c in range(n_columns):
                innovation = columns[row, s, c] - mean[o, c]
                out[row, s, c] = innovation / root
                work[0, c] = innovation
            for i in range(both):
                factor = gain[i]
                for c in range(n_columns):
                    mean[i, c] += factor * work[0, c]
            for i in range(both):
                for j in range(i + 1):
                    cov[i, j] -= gain[i] * gain[j] * variance
                    cov[j, i] = cov[i, j]
    return out, log_det


@njit(cache=True)
def affine_march(transition: FloatArray, offset: FloatArray, start: FloatArray) -> FloatArray:
    """Return the states of x[k+1] = A[k] x[k] + b[k], (n_steps + 1, n), from ``start`` (n,)."""
    n_steps, n = offset.shape
    out = np.empty((n_steps + 1, n))
    out[0] = start
    for k in range(n_steps):
        for i in range(n):
            total = offset[k, i]
            for j in range(n):
                total += transition[k, i, j] * out[k, j]
            out[k + 1, i] = total
    return out
