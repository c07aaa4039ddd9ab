"""Rauch-Tung-Striebel smoother, in the form that keeps covariances positive and tolerates states without noise.

    G = P Aᵀ (A P Aᵀ + Q)⁻¹,   P_s = (I - G A) P (I - G A)ᵀ + G (Q + P_s⁺) Gᵀ

Särkkä and Svensson, *Bayesian Filtering and Smoothing* (2023), theorem 12.2, rewritten as a sum of squares.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from twin_core._typing import BoolArray, FloatArray
from twin_core.errors import ModelError
from twin_core.gp.kalman import SETTLED, Filtered
from twin_core.gp.linalg import alike, cholesky, congruence, multiply, solve_cholesky, transpose
from twin_core.gp.state_space import LinearModel, ModelArrays


@dataclass(frozen=True)
class Smoothed:
    """States given all samples; what was not asked for has length 0.

    Attributes
    ----------
    mean : (n_times, n_states)
    variance : (n_times, n_states)
        Diagonal of the covariance, always there.
    cov : (n_times, n_states, n_states)
    lag_one_cov : (n_steps, n_states, n_states)
        Cov(x[k+1], x[k] | all samples).
    """

    mean: FloatArray
    variance: FloatArray
    cov: FloatArray
    lag_one_cov: FloatArray


class _Scratch(NamedTuple):
    """Square matrices that the compiled loop works in."""

    gain: FloatArray
    reduced: FloatArray
    ahead: FloatArray
    lower: FloatArray
    work: FloatArray
    turned: FloatArray
    forward: FloatArray
    later: FloatArray


class _Store(NamedTuple):
    """Where the compiled loop writes; arrays of length 0 are not written."""

    mean: FloatArray
    variance: FloatArray
    cov: FloatArray
    lag_one_cov: FloatArray


@njit(cache=True)
def _prepare_gain(a: FloatArray, q: FloatArray, cov: FloatArray, s: _Scratch) -> None:
    """Fill ``gain`` = G and ``reduced`` = (I - G A) P (I - G A)ᵀ."""
    n = cov.shape[0]
    congruence(a, cov, s.forward, s.turned, s.ahead)
    for i in range(n):
        for j in range(n):
            s.ahead[i, j] += q[i, j]
    cholesky(s.ahead, s.lower)
    solve_cholesky(s.lower, s.forward)
    transpose(s.forward, s.gain)
    multiply(s.gain, a, s.work)
    for i in range(n):
        for j in range(n):
            s.work[i, j] = -s.work[i, j]
        s.work[i, i] += 1.0
    congruence(s.work, cov, s.forward, s.turned, s.reduced)


@njit(cache=True)
def _correct_mean(
    a: FloatArray, b: FloatArray, gain: FloatArray, filtered: FloatArray, mean: FloatArray, shift: FloatArray
) -> None:
    """Replace the later step's smoothed mean by this step's: m + G (m⁺ - A m - b)."""
    n = mean.size
    for i in range(n):
        shift[i] = mean[i] - b[i]
        for j in range(n):
            shift[i] -= a[i, j] * filtered[j]
    for i in range(n):
        mean[i] = filtered[i]
        for j in range(n):
            mean[i] += gain[i, j] * shift[j]


@njit(cache=True)
def _correct_cov(q: FloatArray, cov: FloatArray, s: _Scratch) -> None:
    """Replace the later step's smoothed covariance by this step's; the later one stays in ``later``."""
    n = cov.shape[0]
    for i in range(n):
        for j in range(n):
            s.later[i, j] = cov[i, j]
            cov[i, j] += q[i, j]
    congruence(s.gain, cov, s.work, s.turned, s.ahead)
    for i in range(n):
        for j in range(n):
            cov[i, j] = s.ahead[i, j] + s.reduced[i, j]


@njit(cache=True)
def _run(
    model: ModelArrays, means: FloatArray, covs: FloatArray, settled: BoolArray, tolerance: float, store: _Store
) -> None:
    """Smooth backwards from the filtered ``means`` and ``covs``."""
    n_times, n = means.shape
    mean, cov, shift = means[n_times - 1].copy(), covs[n_times - 1].copy(), np.empty(n)
    s = _Scratch(
        np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n)),
        np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n)),
    )  # fmt: skip
    steady = False
    for k in range(n_times - 1, -1, -1):
        if k < n_times - 1:
            d = model.step_index[k]
            repeats = k < n_times - 2 and settled[k + 1] and model.step_index[k + 1] == d
            steady = steady and repeats
            if not repeats:
                _prepare_gain(model.transition[d], model.process_cov[d], covs[k], s)
            _correct_mean(model.transition[d], model.offset[k], s.gain, means[k], mean, shift)
            if store.lag_one_cov.shape[0] > 0:
                transpose(s.gain, s.turned)
                multiply(cov, s.turned, store.lag_one_cov[k])
            if not steady:
                _correct_cov(model.process_cov[d], cov, s)
                steady = repeats and alike(cov, s.later, tolerance)
        store.mean[k] = mean
        for i in range(n):
            store.variance[k, i] = cov[i, i]
        if store.cov.shape[0] > 0:
            store.cov[k] = cov


def smooth(
    model: LinearModel,
    filtered: Filtered,
    *,
    keep_cov: bool = True,
    keep_lag_one: bool = False,
    settle_tolerance: float = SETTLED,
) -> Smoothed:
    """Smooth what a filter returned.

    Parameters
    ----------
    model
        The model that was filtered.
    filtered
        With its states kept.
    keep_cov, keep_lag_one
        Whether to store full covariances, and those of neighbouring samples.
    settle_tolerance
        As in :func:`twin_core.gp.kalman.kalman_filter`.

    Raises
    ------
    ModelError
        The filter kept no states.
    """
    if filtered.mean.shape[0] != model.n_times:
        raise ModelError("the smoother needs the filtered states: filter with keep='states'")
    n_times, n = filtered.mean.shape
    store = _Store(
        np.empty((n_times, n)),
        np.empty((n_times, n)),
        np.empty((n_times if keep_cov else 0, n, n)),
        np.empty((n_times - 1 if keep_lag_one else 0, n, n)),
    )
    _run(model.arrays, filtered.mean, filtered.cov, filtered.settled, float(settle_tolerance), store)
    return Smoothed(*store)
