"""The derivatives of ``derivatives`` for networks of many nodes: the same formulas, carried out by BLAS and LAPACK.

The compiled loops are the quicker ones below some dozens of nodes; beyond, products and factors of full matrices decide.
"""

import numpy as np
from scipy.linalg import lu_factor, lu_solve
from scipy.sparse import csr_array

from twin_core._typing import FloatArray, IntArray
from twin_core.simulate.modes import Modes, divided_differences, weights

MANY = 48
"""Nodes from which on this way is the quicker one."""


SPARSE = 0.15
"""Up to this share of n entries per column that changes A they are taken one by one: gathering costs several times a product."""


class _Pattern:
    """Where a sparse matrix has its entries; several at one place add up."""

    def __init__(self, row: IntArray, column: IntArray, shape: tuple[int, int]) -> None:
        cells, self._place = np.unique(row * shape[1] + column, return_inverse=True)
        self._indices, self._shape = cells % shape[1], shape
        self._pointers = np.searchsorted(cells, np.arange(shape[0] + 1) * shape[1])

    def filled(self, entries: FloatArray) -> csr_array:
        """Return the matrix with these values."""
        values = np.bincount(self._place, weights=entries, minlength=self._indices.size)
        return csr_array((values, self._indices, self._pointers), shape=self._shape)


class _Turning:
    """How columns change A, (n_turned, n, n), multiplied with what differs from step to step."""

    def __init__(self, modes: Modes, turning: FloatArray) -> None:
        self._dense: FloatArray | None = None
        which, row, self._column = np.nonzero(turning)
        each = np.bincount(which, minlength=turning.shape[0])
        if not each.all() or which.size > SPARSE * turning.shape[0] * turning.shape[1]:
            in_modes = modes.inward @ turning @ modes.outward
            self._dense = np.ascontiguousarray(in_modes.transpose(1, 0, 2))  # (n, n_turned, n)
            return
        self._outward = modes.outward.T
        self._inward = modes.inward[:, row] * turning[which, row, self._column]
        self._first = np.cumsum(each) - each

    def times(self, mixed: FloatArray) -> FloatArray:
        """Return sum_j (inward dA outward)[t, i, j] mixed[i, j], (n, n_turned)."""
        if self._dense is not None:
            return np.asarray((self._dense @ mixed[:, :, None])[:, :, 0])
        through = mixed @ self._outward
        return np.add.reduceat(self._inward * through[:, self._column], self._first, axis=1)


def march_sensitivities_of_many(
    step_s: FloatArray,
    modes: Modes,
    row: IntArray,
    column: IntArray,
    entry: FloatArray,
    stages: FloatArray,
    rate: FloatArray,
    turned: IntArray,
    turning: FloatArray,
    entry_column: IntArray,
    entry_node: IntArray,
    entry_series: FloatArray,
    start: FloatArray,
    sample_step: IntArray,
    observed: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Advance d state / d column along a trajectory without relays.

    Arguments and result as of ``march_sensitivities``, but ``turning`` is (n_turned, n, n) dA between nodes: a coupling changes
    four of its entries, which are taken one by one where they are few.
    """
    n_steps, (n, n_columns) = step_s.size, start.shape
    out = np.empty((sample_step.size, observed.size, n_columns))
    state, at_s = start.copy(), np.nan
    keep, whole, late = np.empty(n), np.empty(n), np.empty(n)
    divided = np.empty((3, n, n))
    out[sample_step == 0] = state[observed]
    samples = {int(k): np.flatnonzero(sample_step == k) for k in np.unique(sample_step)}
    mode, pushed = stages @ modes.inward.T, rate @ modes.inward.T
    pushed -= modes.rate_per_s * mode
    fed, among = np.unique(entry_column, return_inverse=True)  # the columns of parameters; most may be initial states
    rest = _Pattern(row, column, (n, n))
    given = _Pattern(entry_node, among, (n, fed.size))
    turn = _Turning(modes, turning)
    for k in range(n_steps):
        if step_s[k] != at_s:
            at_s = float(step_s[k])
            weights(at_s, modes.rate_per_s, keep, whole, late)
            early = whole - late
            dense_keep, dense_early, dense_late = (
                (modes.outward * weight) @ modes.inward for weight in (keep, early, late)
            )
            if turned.size > 0:
                divided_differences(at_s, modes.rate_per_s, keep, early, late, divided)
        first, last = (rest.filled(entry[k, side]) for side in (0, 1))
        work = (dense_keep + (first.T @ dense_early.T).T) @ state
        for side, dense in enumerate((dense_early, dense_late) if fed.size else ()):
            work[:, fed] += (given.filled(entry_series[:, k, side]).T @ dense.T).T
        if turned.size > 0:
            mixed = divided[0] * mode[k, 0] + divided[1] * pushed[k, 0] + divided[2] * pushed[k, 1]
            mixed -= early[:, None] * mode[k, 0] + late[:, None] * mode[k, 1]
            work[:, turned] += modes.outward @ turn.times(mixed)
        backward = np.eye(n) - (last.T @ dense_late.T).T
        state = lu_solve(lu_factor(backward, overwrite_a=True, check_finite=False), work, check_finite=False)
        if k + 1 in samples:
            out[samples[k + 1]] = state[observed]
    return out, state
