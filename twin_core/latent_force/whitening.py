"""A compiled filter that whitens many columns at once in the metric of sensor noise plus undeclared heat.

The network carries an Ornstein-Uhlenbeck heat on every node. Readings, sensitivities and candidate responses all pass
through the one filter that this implies; its innovations are white, so that plain least squares on them is generalised
least squares on the readings (Särkkä and Svensson 2023, section 12.3).
"""

import numpy as np
from numba import njit

from twin_core._typing import BoolArray, FloatArray, IntArray

SETTLED = 1e-6
"""A covariance that moves by less from sample to sample, in units of its deviations, has reached its limit: the likelihood of
a thousand samples of seven sensors changes by less than a thousandth of a nat."""


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _predict_covariance(
    full: FloatArray, cov: FloatArray, turned: FloatArray, keep: float, force: FloatArray, state: FloatArray
) -> None:
    """Advance the covariance of [temperatures, heats]: the heats only decay, so that half of the product is cheap."""
    both = cov.shape[0]
    n = both // 2
    for i in range(n):
        for j in range(both):
            turned[i, j] = 0.0
        for m in range(both):
            factor = full[i, m]
            if factor != 0.0:
                for j in range(both):
                    turned[i, j] += factor * cov[m, j]
    for i in range(n, both):
        for j in range(i + 1):
            if j >= n:
                cov[i, j] *= keep * keep
                cov[j, i] = cov[i, j]
    for i in range(n):
        for j in range(n, both):
            cov[i, j] = turned[i, j] * keep
            cov[j, i] = cov[i, j]
        for j in range(i + 1):
            total = 0.0
            for m in range(both):
                total += turned[i, m] * full[j, m]
            cov[i, j] = total
            cov[j, i] = total
    for i in range(n):
        cov[i, i] += state[i]
        cov[n + i, n + i] += force[i] * (1.0 - keep * keep)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _predict_columns(full: FloatArray, mean: FloatArray, work: FloatArray, keep: float) -> None:
    """Advance the mean of every column."""
    both, n_columns = mean.shape
    n = both // 2
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
            mean[n + i, c] *= keep


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _condition(o: int, noise: float, cov: FloatArray, gain: FloatArray) -> float:
    """Condition the covariance on one sensor; write the gain; return the variance of the innovation."""
    both = cov.shape[0]
    variance = cov[o, o] + noise
    for i in range(both):
        gain[i] = cov[i, o] / variance
    for i in range(both):
        moved = gain[i] * variance
        for j in range(both):
            cov[i, j] -= moved * gain[j]
    return variance


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _correct_columns(
    o: int, root: float, gain: FloatArray, mean: FloatArray, reading: FloatArray, out: FloatArray
) -> None:
    """Correct the mean of every column by one reading; write whitened innovations."""
    both, n_columns = mean.shape
    for c in range(n_columns):
        out[c] = reading[c] - mean[o, c]
    for i in range(both):
        for c in range(n_columns):
            mean[i, c] += gain[i] * out[c]
    for c in range(n_columns):
        out[c] /= root


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _predict_column(full: FloatArray, mean: FloatArray, work: FloatArray, keep: float) -> None:
    """Advance a single mean, (2 n,): the columns' loop has nothing to run over, so that rows must."""
    both = mean.size
    n = both // 2
    for i in range(n):
        total = 0.0
        for j in range(both):
            total += full[i, j] * mean[j]
        work[i] = total
    for i in range(n):
        mean[i] = work[i]
        mean[n + i] *= keep


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _correct_column(o: int, root: float, gain: FloatArray, mean: FloatArray, reading: float) -> float:
    """Correct a single mean by one reading; return the whitened innovation."""
    innovation = reading - mean[o]
    for i in range(mean.size):
        mean[i] += gain[i] * innovation
    return innovation / root


@njit(cache=True, nogil=True, error_model="numpy")
def _settled(cov: FloatArray, before: FloatArray) -> bool:
    """Return whether a covariance has stopped moving: by less than ``SETTLED`` in units of its deviations."""
    for i in range(cov.shape[0]):
        for j in range(i + 1):
            if (cov[i, j] - before[i, j]) ** 2 > SETTLED**2 * cov[i, i] * cov[j, j]:
                return False
    return True


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def whiten_columns(
    transition: FloatArray,
    response: FloatArray,
    keep: FloatArray,
    kind: IntArray,
    force_variance: FloatArray,
    state_variance: FloatArray,
    observed: IntArray,
    noise_variance: FloatArray,
    start_variance: FloatArray,
    sample_of: IntArray,
    interval: IntArray,
    valid: BoolArray,
    columns: FloatArray,
) -> tuple[FloatArray, float]:
    """Pass columns of readings through the filter.

    Where the same kind of interval follows itself, the covariance soon stops moving (the algebraic Riccati equation; Anderson
    and Moore, Optimal Filtering, 1979, section 4.4): from there on only the columns are advanced, with the gains at hand.

    Parameters
    ----------
    transition, response : (n_kinds, n, n)
        d end / d start, and d end / d heat held over a step of each kind.
    keep : (n_kinds,)
        exp(-h / length) of the heat.
    kind : (n_steps,)
        Which kind of step each one is.
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
    interval : (n_steps,)
        For each step which kind of interval, from sample to sample, it belongs to: the same steps, and the same sensors
        read at its end. Negative where it is like no other.
    valid : (n_samples, n_sensors)
    columns : (n_samples, n_sensors, n_columns)

    Returns
    -------
    (n_samples, n_sensors, n_columns), float
        Innovations over their standard deviation, zero where invalid; ln det of the covariance of the readings.
    """
    n_steps, n = kind.size, transition.shape[1]
    out = np.zeros_like(columns)
    cov, full, turned = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 * n)), np.empty((2 * n, 2 * n))
    before = np.zeros((2 * n, 2 * n))
    mean, work = np.zeros((2 * n, columns.shape[2])), np.empty((n, columns.shape[2]))
    only, own_work, is_single = np.zeros(2 * n), np.empty(n), columns.shape[2] == 1
    gains, roots, logs = np.zeros((observed.size, 2 * n)), np.ones(observed.size), np.zeros(observed.size)
    for i in range(n):
        cov[i, i] = start_variance[i]
        cov[n + i, n + i] = force_variance[i]
    log_det, last, settled, filled = 0.0, -1, -1, -1
    for k in range(n_steps + 1):
        here = interval[k - 1] if k > 0 else -1
        frozen = here >= 0 and here == settled
        if k > 0:
            c = kind[k - 1]
            if c != filled:
                full[:n, :n] = transition[c]
                full[:n, n:] = response[c]
                filled = c
            if not frozen:
                settled = -1
                _predict_covariance(full, cov, turned, keep[c], force_variance, state_variance)
            if is_single:
                _predict_column(full, only, own_work, keep[c])
            else:
                _predict_columns(full, mean, work, keep[c])
        row = sample_of[k]
        if row < 0:
            continue
        for s in range(observed.size):
            if valid[row, s]:
                if not frozen:
                    variance = _condition(observed[s], noise_variance[s], cov, gains[s])
                    roots[s], logs[s] = np.sqrt(variance), np.log(variance)
                log_det += logs[s]
                if is_single:
                    reading = columns[row, s, 0]
                    out[row, s, 0] = _correct_column(observed[s], roots[s], gains[s], only, reading)
                else:
                    _correct_columns(observed[s], roots[s], gains[s], mean, columns[row, s], out[row, s])
        if not frozen:
            if here >= 0 and here == last and _settled(cov, before):
                settled = here
            before[:] = cov
            last = here
    return out, log_det


@njit(cache=True, nogil=True)
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
