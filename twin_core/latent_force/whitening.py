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
    full: FloatArray,
    cov: FloatArray,
    turned: FloatArray,
    own: FloatArray,
    keep: float,
    force: FloatArray,
    state: FloatArray,
) -> None:
    """Advance the covariance of [temperatures, heats]: the heats only decay, so that half of the product is enough."""
    n = full.shape[0]
    np.dot(full, cov, turned)
    np.dot(turned, full.T, own)
    for i in range(n):
        for j in range(n):
            cov[i, j] = own[i, j]
            cov[i, n + j] = turned[i, n + j] * keep
            cov[n + i, n + j] *= keep * keep
        cov[i, i] += state[i]
        cov[n + i, n + i] += force[i] * (1.0 - keep * keep)
    for i in range(n):
        for j in range(n):
            cov[n + i, j] = cov[j, n + i]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _condition(
    observed: IntArray,
    noise: FloatArray,
    valid: BoolArray,
    cov: FloatArray,
    fall: FloatArray,
    gains: FloatArray,
    roots: FloatArray,
) -> float:
    """Condition the covariance on the valid sensors, one after the other; return ln det of the innovations' covariance.

    ``gains``, (n_sensors, 2 n), and ``roots`` are written: what a whitened innovation of each sensor adds to the mean, and the
    deviation of its innovation given those of the sensors before it. Without a reading the gain is zero.
    """
    both, log_det = cov.shape[0], 0.0
    for s in range(observed.size):
        gain, o = gains[s], observed[s]
        if not valid[s]:
            gain[:] = 0.0
            continue
        for i in range(both):
            gain[i] = cov[o, i]
        for r in range(s):
            share = gains[r, o]
            for i in range(both):
                gain[i] -= share * gains[r, i]
        roots[s] = np.sqrt(gain[o] + noise[s])
        log_det += 2.0 * np.log(roots[s])
        for i in range(both):
            gain[i] /= roots[s]
    np.dot(gains.T, gains, fall)
    for i in range(both):
        for j in range(both):
            cov[i, j] -= fall[i, j]
    return log_det


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _predict_columns(full: FloatArray, mean: FloatArray, work: FloatArray, keep: float) -> None:
    """Advance the mean of every column."""
    n = full.shape[0]
    np.dot(full, mean, work)
    for i in range(n):
        for c in range(mean.shape[1]):
            mean[i, c] = work[i, c]
            mean[n + i, c] *= keep


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _correct_columns(
    observed: IntArray,
    valid: BoolArray,
    gains: FloatArray,
    roots: FloatArray,
    mean: FloatArray,
    change: FloatArray,
    readings: FloatArray,
    out: FloatArray,
) -> None:
    """Correct the mean of every column by the readings of one sample; write whitened innovations, (n_sensors, n_columns)."""
    both, n_columns = mean.shape
    for s in range(observed.size):
        if valid[s]:
            o = observed[s]
            for c in range(n_columns):
                out[s, c] = readings[s, c] - mean[o, c]
            for r in range(s):
                share = gains[r, o]
                for c in range(n_columns):
                    out[s, c] -= share * out[r, c]
            for c in range(n_columns):
                out[s, c] /= roots[s]
    np.dot(gains.T, out, change)
    for i in range(both):
        for c in range(n_columns):
            mean[i, c] += change[i, c]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _predict_column(full: FloatArray, mean: FloatArray, work: FloatArray, keep: float) -> None:
    """Advance a single mean, (2 n,): the columns' loop has nothing to run over, so that rows must."""
    n = full.shape[0]
    for i in range(n):
        total = 0.0
        for j in range(2 * n):
            total += full[i, j] * mean[j]
        work[i] = total
    for i in range(n):
        mean[i] = work[i]
        mean[n + i] *= keep


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _correct_column(o: int, root: float, gain: FloatArray, mean: FloatArray, reading: float) -> float:
    """Correct a single mean by one reading; return the whitened innovation."""
    innovation = (reading - mean[o]) / root
    for i in range(mean.size):
        mean[i] += gain[i] * innovation
    return innovation


@njit(cache=True, nogil=True, error_model="numpy")
def is_settled(cov: FloatArray, before: FloatArray) -> bool:
    """Return whether a covariance has stopped moving: by less than ``SETTLED`` in units of its deviations."""
    for i in range(cov.shape[0]):
        for j in range(i + 1):
            if (cov[i, j] - before[i, j]) ** 2 > SETTLED**2 * cov[i, i] * cov[j, j]:
                return False
    return True


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def filtered(
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
    gains_of: FloatArray,
    roots_of: FloatArray,
    gain_at: IntArray,
) -> tuple[FloatArray, float]:
    """Do what :func:`whiten_columns` says; keep what an adjoint needs, unless ``gain_at`` is empty.

    Gains and deviations, as ``_condition`` writes them, of every sample at which they are new; for each sample which these are.
    """
    n_steps, n = kind.size, transition.shape[1]
    n_columns, out = columns.shape[2], np.zeros_like(columns)
    cov, before, fall = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 * n)), np.empty((2 * n, 2 * n))
    full, turned, own = np.empty((n, 2 * n)), np.empty((n, 2 * n)), np.empty((n, n))
    mean, change, work = np.zeros((2 * n, n_columns)), np.empty((2 * n, n_columns)), np.empty((n, n_columns))
    only, own_work, is_single = np.zeros(2 * n), np.empty(n), n_columns == 1
    gains, roots = np.zeros((observed.size, 2 * n)), np.ones(observed.size)
    for i in range(n):
        cov[i, i] = start_variance[i]
        cov[n + i, n + i] = force_variance[i]
    log_det, here_log_det, last, settled, filled, n_kept = 0.0, 0.0, -1, -1, -1, 0
    for k in range(n_steps + 1):
        here = interval[k - 1] if k > 0 else -1
        frozen = here >= 0 and here == settled
        if k > 0:
            c = kind[k - 1]
            if c != filled:
                full[:, :n] = transition[c]
                full[:, n:] = response[c]
                filled = c
            if not frozen:
                settled = -1
                _predict_covariance(full, cov, turned, own, keep[c], force_variance, state_variance)
            if is_single:
                _predict_column(full, only, own_work, keep[c])
            else:
                _predict_columns(full, mean, work, keep[c])
        row = sample_of[k]
        if row < 0:
            continue
        if not frozen:
            here_log_det = _condition(observed, noise_variance, valid[row], cov, fall, gains, roots)
            if here >= 0 and here == last and is_settled(cov, before):
                settled = here
            before[:] = cov
            last = here
            if gain_at.size:
                gains_of[n_kept], roots_of[n_kept] = gains, roots
                n_kept += 1
        if gain_at.size:
            gain_at[row] = n_kept - 1
        log_det += here_log_det
        if not is_single:
            _correct_columns(observed, valid[row], gains, roots, mean, change, columns[row], out[row])
            continue
        for s in range(observed.size):
            if valid[row, s]:
                out[row, s, 0] = _correct_column(observed[s], roots[s], gains[s], only, columns[row, s, 0])
    return out, log_det


@njit(cache=True, nogil=True)
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
    nothing = np.empty((0, 0, 0)), np.empty((0, 0)), np.empty(0, dtype=np.int64)
    return filtered(
        transition,
        response,
        keep,
        kind,
        force_variance,
        state_variance,
        observed,
        noise_variance,
        start_variance,
        sample_of,
        interval,
        valid,
        columns,
        *nothing,
    )


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
