"""The slope of the likelihood in the sizes of the undeclared heats, by the adjoint of the compiled filter.

Half of the square of the adjoint mean less the adjoint covariance is the derivative of the log-likelihood by what a step adds
to the covariance. Both come from the backward recursion of Bryson and Frazier in its modified form (Bierman 1973, "Fixed
interval smoothing with discrete measurements", International Journal of Control 18; Koopman and Shephard 1992, "Exact score for
time series models in state space form", Biometrika 79).
"""

import numpy as np
from numba import njit

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.latent_force.whitening import filtered, is_settled


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _read_back(
    observed: IntArray,
    valid: BoolArray,
    gains: FloatArray,
    roots: FloatArray,
    whitened: FloatArray,
    adjoint: FloatArray,
    spread: FloatArray,
    work: FloatArray,
    still: bool,
) -> None:
    """Take the adjoint mean and covariance back over the readings of one sample, the last sensor first."""
    both = adjoint.size
    for s in range(observed.size - 1, -1, -1):
        if not valid[s]:
            continue
        gain, root, o = gains[s], roots[s], observed[s]
        told = whitened[s]
        for i in range(both):
            told += gain[i] * adjoint[i]
        adjoint[o] -= told / root
        if still:
            continue
        square = 1.0
        for i in range(both):
            total = 0.0
            for j in range(both):
                total += spread[i, j] * gain[j]
            work[i] = total / root
            square += total * gain[i]
        for i in range(both):
            spread[o, i] -= work[i]
            spread[i, o] -= work[i]
        spread[o, o] += square / root**2


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _step_back(
    full: FloatArray,
    keep: float,
    adjoint: FloatArray,
    spread: FloatArray,
    turned: FloatArray,
    half: FloatArray,
    work: FloatArray,
    still: bool,
) -> None:
    """Take the adjoint mean and covariance back over one step."""
    n = full.shape[0]
    work[:n] = 0.0
    for j in range(n):
        work[n + j] = keep * adjoint[n + j]
    for i in range(n):
        for j in range(2 * n):
            work[j] += full[i, j] * adjoint[i]
    adjoint[:] = work
    if still:
        return
    np.dot(full.T, spread[:n], turned)
    for i in range(n):
        for j in range(2 * n):
            turned[n + i, j] += keep * spread[n + i, j]
    for i in range(2 * n):
        for j in range(n):
            half[j, i] = turned[i, j]
    np.dot(full.T, half, spread)
    for i in range(2 * n):
        for j in range(n):
            spread[n + j, i] += keep * turned[i, n + j]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def size_score(
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
) -> tuple[float, FloatArray]:
    """Return the log-likelihood of one column of readings, less its constant, and its slope in ln of the size on each node.

    The parameters are those of :func:`~twin_core.latent_force.whitening.whiten_columns`, with a single column. Where the filter
    has settled its adjoint settles too, and only its mean is taken back from there.

    Returns
    -------
    float, (n_nodes,)
    """
    n_steps, n, n_sensors = kind.size, transition.shape[1], observed.size
    gains_of, roots_of = np.empty((valid.shape[0], n_sensors, 2 * n)), np.empty((valid.shape[0], n_sensors))
    gain_at = np.empty(valid.shape[0], dtype=np.int64)
    whitened, log_det = filtered(
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
        gains_of,
        roots_of,
        gain_at,
    )
    full, turned, half = np.empty((n, 2 * n)), np.empty((2 * n, 2 * n)), np.empty((n, 2 * n))
    adjoint, spread, before = np.zeros(2 * n), np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 * n))
    work, slope, interval_slope = np.empty(2 * n), np.zeros(n), np.zeros(n)
    last, settled, filled = -1, -1, -1
    for k in range(n_steps, -1, -1):
        row = sample_of[k]
        if row >= 0:
            here = gain_at[row] if k > 0 and interval[k - 1] >= 0 else -1
            if here < 0 or here != settled:
                settled = here if here >= 0 and here == last and is_settled(spread, before) else -1
                before[:] = spread
                last = here
            if settled >= 0:
                slope -= interval_slope
            else:
                interval_slope[:] = 0.0
            at = gain_at[row]
            own = whitened[row, :, 0]
            _read_back(observed, valid[row], gains_of[at], roots_of[at], own, adjoint, spread, work, settled >= 0)
        c = kind[k - 1] if k > 0 else -1
        for i in range(n):
            added = force_variance[i] * (1.0 - keep[c] ** 2) if k > 0 else force_variance[i]
            slope[i] += added * adjoint[n + i] ** 2
            if settled < 0 or k == 0:
                slope[i] -= added * spread[n + i, n + i]
                interval_slope[i] += added * spread[n + i, n + i]
        if k > 0:
            if c != filled:
                full[:, :n] = transition[c]
                full[:, n:] = response[c]
                filled = c
            _step_back(full, keep[c], adjoint, spread, turned, half, work, settled >= 0)
    return -0.5 * ((whitened**2).sum() + log_det), slope
