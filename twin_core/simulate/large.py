"""The derivatives of ``derivatives`` for networks of many nodes: the same formulas, carried out by BLAS and LAPACK.

The compiled loops are the quicker ones below some dozens of nodes; beyond, products and factors of full matrices decide. What
a step adds to the columns of parameters is gathered in the modes of A, and brought to the nodes by the product that solves for
the end of the step as well.
"""

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, IntArray
from twin_core.simulate.modes import Modes, divided_differences, weights
from twin_core.simulate.splitting import Turning

MANY = 48
"""Nodes from which on this way is the quicker one."""

SPARSE = 1.0
"""Up to this share of n entries per column that changes A they are taken one by one: beyond, a product of full matrices is
quicker."""


FILLED = 0.05
"""Beyond this share of entries a change of A is quicker as a full matrix than entry by entry."""


@njit(cache=True, nogil=True)
def _add_entries(row: IntArray, column: IntArray, entry: FloatArray, weight: FloatArray, out: FloatArray) -> None:
    """Add weight @ (the matrix with these entries) to ``out``, both transposed."""
    for e in range(row.size):
        for i in range(out.shape[1]):
            out[column[e], i] += weight[row[e], i] * entry[e]


def _add_changed(row: IntArray, column: IntArray, entry: FloatArray, weight: FloatArray, out: FloatArray) -> None:
    """Add weight @ (the matrix with these entries) to ``out``, both transposed, the quicker way."""
    n = out.shape[0]
    if row.size > FILLED * n * n:
        out += np.bincount(column * n + row, weights=entry, minlength=n * n).reshape(n, n) @ weight
    else:
        _add_entries(row, column, entry, weight, out)


@njit(cache=True, nogil=True)
def _gather(
    entry_column: IntArray,
    entry_node: IntArray,
    entry_series: FloatArray,
    k: int,
    early: FloatArray,
    late: FloatArray,
    inward: FloatArray,
    out: FloatArray,
) -> None:
    """Add what rates that depend on columns do over step k, in modes; ``inward`` and ``out`` are transposed."""
    for e in range(entry_column.size):
        first, last = entry_series[e, k, 0], entry_series[e, k, 1]
        if first != 0.0 or last != 0.0:
            for i in range(early.size):
                out[entry_column[e], i] += inward[entry_node[e], i] * (early[i] * first + late[i] * last)


@njit(cache=True, nogil=True)
def _turn(
    turned: IntArray,
    row: IntArray,
    column: IntArray,
    value: FloatArray,
    inward: FloatArray,
    through: FloatArray,
    out: FloatArray,
) -> None:
    """Add sum_j (inward dA outward)[i, j] mixed[i, j] of the entries of every dA; all matrices are transposed."""
    for e in range(turned.size):
        for i in range(inward.shape[1]):
            out[turned[e], i] += value[e] * inward[row[e], i] * through[column[e], i]


class _Turned:
    """How columns change A, multiplied with what differs from step to step."""

    def __init__(self, modes: Modes, turns: Turning) -> None:
        self._turns, self._outward, self._dense = turns, modes.outward, None
        n = modes.rate_per_s.size
        if turns.row.size > SPARSE * turns.columns.size * n:
            in_modes = modes.inward @ turns.dense(n) @ modes.outward
            self._dense = np.ascontiguousarray(in_modes.transpose(1, 0, 2))  # (n, n_turned, n)
        self._columns = turns.columns[turns.which]

    def add(self, mixed: FloatArray, inward: FloatArray, out: FloatArray) -> None:
        """Add sum_j (inward dA outward)[i, j] mixed[i, j] of every column to (n_columns, n); ``inward`` is transposed."""
        turns = self._turns
        if self._dense is not None:
            out[turns.columns] += (self._dense @ mixed[:, :, None])[:, :, 0].T
        else:
            through = self._outward @ mixed.T
            _turn(self._columns, turns.row, turns.column, turns.value_W_per_K, inward, through, out)


def march_sensitivities_of_many(
    step_s: FloatArray,
    modes: Modes,
    row: IntArray,
    column: IntArray,
    entry: FloatArray,
    stages: FloatArray,
    rate: FloatArray,
    turns: Turning,
    entry_column: IntArray,
    entry_node: IntArray,
    entry_series: FloatArray,
    start: FloatArray,
    sample_step: IntArray,
    observed: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Advance d state / d column along a trajectory without relays.

    Arguments and result as of ``march_sensitivities``, but ``turns`` is dA between nodes: a coupling changes four of its entries,
    which are taken one by one where they are few.
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
    moved = 1 + max(
        int(turns.columns.max(initial=-1)), int(entry_column.max(initial=-1))
    )  # columns of parameters come first
    turned = _Turned(modes, turns)
    inward, outward = (np.ascontiguousarray(matrix.T) for matrix in (modes.inward, modes.outward))
    given, identity = np.empty((moved, n)), np.eye(n)
    for k in range(n_steps):
        if step_s[k] != at_s:
            at_s = float(step_s[k])
            weights(at_s, modes.rate_per_s, keep, whole, late)
            early = whole - late
            turned_keep, turned_early, turned_late = ((inward * weight) @ outward for weight in (keep, early, late))
            if turns.columns.size > 0:
                divided_differences(at_s, modes.rate_per_s, keep, early, late, divided)
        forward, backward = turned_keep.copy(), identity.copy()
        _add_changed(row, column, entry[k, 0], turned_early, forward)
        _add_changed(row, column, -entry[k, 1], turned_late, backward)
        # Close to the identity, so that its inverse is as good as its factors, and the quicker way to products.
        solved = np.concatenate([forward, outward]) @ np.linalg.inv(backward)
        given[:] = 0.0
        _gather(entry_column, entry_node, entry_series, k, early, late, inward, given)
        if turns.columns.size > 0:
            mixed = divided[0] * mode[k, 0] + divided[1] * pushed[k, 0] + divided[2] * pushed[k, 1]
            mixed -= early[:, None] * mode[k, 0] + late[:, None] * mode[k, 1]
            turned.add(mixed, inward, given)
        state = solved[:n].T @ state
        state[:, :moved] += solved[n:].T @ given.T
        if k + 1 in samples:
            out[samples[k + 1]] = state[observed]
    return out, state
