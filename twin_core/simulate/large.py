"""The derivatives of ``derivatives`` for networks of many nodes: the same formulas, carried out by BLAS and LAPACK.

The compiled loops are the quicker ones below some dozens of nodes; beyond, products and factors of full matrices decide. What
a step adds to the columns of parameters is gathered in the modes of A and brought to the nodes with the rest of the step. To the
columns of initial temperatures nothing is added: as the quick modes die out they span less and less, and what is carried on is
a basis of what is left.
"""

import numpy as np
from numba import njit
from scipy.linalg import qr

from twin_core._typing import FloatArray, IntArray
from twin_core.simulate.modes import Modes, divided_differences, weights
from twin_core.simulate.splitting import Turning

MANY = 48
"""Nodes from which on this way is the quicker one."""

SPARSE = 0.2
"""Up to this share of n entries per column that changes A they are taken one by one: beyond, a product of full matrices is
quicker. Measured side by side on one core with 100 to 658 nodes and 30 or 100 columns: one by one takes 0.3 to 1.6 times as long
at a share of 0.1, 1.4 to 3 times at 0.3, 6 times at 1; with 6 columns full matrices are always the quicker way."""

FILLED = 0.04
"""Beyond this share of entries a change of A is quicker as a full matrix than entry by entry. Measured side by side on one core
with 100 to 658 nodes: entry by entry takes 0.4 to 0.8 of the time at 2 %, 1.2 to 1.9 times as long at 5 %, 2 to 4 at 10 %."""


FADED = 1e-12
"""What is smaller than this, beside the largest derivative by an initial temperature at the start, is no longer carried on."""


@njit(cache=True, nogil=True)
def _add_entries(row: IntArray, column: IntArray, entry: FloatArray, weight: FloatArray, out: FloatArray) -> None:
    """Add weight @ (the matrix with these entries) to ``out``, both transposed."""
    for e in range(row.size):
        for i in range(out.shape[1]):
            out[column[e], i] += weight[row[e], i] * entry[e]


@njit(cache=True, nogil=True)
def _times_entries(row: IntArray, column: IntArray, entry: FloatArray, state: FloatArray, out: FloatArray) -> None:
    """Add (the matrix with these entries) @ state to ``out``."""
    for e in range(row.size):
        for i in range(out.shape[1]):
            out[row[e], i] += entry[e] * state[column[e], i]


def _filled(row: IntArray, column: IntArray, entry: FloatArray, n: int) -> FloatArray:
    """Return the matrix with these entries, (n, n)."""
    filled = np.bincount(row * n + column, weights=entry, minlength=n * n).reshape(n, n)
    return filled.astype(np.float64, copy=False)


def _changed(row: IntArray, column: IntArray, entry: FloatArray, state: FloatArray) -> FloatArray:
    """Return (the matrix with these entries) @ state, the quicker way."""
    n = state.shape[0]
    if row.size > FILLED * n * n:
        return _filled(row, column, entry, n) @ state
    out = np.zeros_like(state)
    _times_entries(row, column, entry, state, out)
    return out


def _spanned(columns: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """Return a basis of the columns, (n, rank), and their shares in it, (rank, n_columns); what is below ``least`` is nothing."""
    if columns.shape[1] == 0:
        return columns, np.zeros((0, 0))
    basis, triangle, order = qr(columns, mode="economic", pivoting=True, check_finite=False)
    rank = int(np.count_nonzero(np.abs(np.diag(triangle)) > least))
    shares = np.empty((rank, order.size))
    shares[:, order] = triangle[:rank]
    return basis[:, :rank], shares


def _add_changed(row: IntArray, column: IntArray, entry: FloatArray, weight: FloatArray, out: FloatArray) -> None:
    """Add weight @ (the matrix with these entries) to ``out``, both transposed, the quicker way."""
    n = out.shape[0]
    if row.size > FILLED * n * n:
        out += _filled(column, row, entry, n) @ weight
    else:
        _add_entries(row, column, entry, weight, out)


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
    out[sample_step == 0] = start[observed]
    samples = {int(k): np.flatnonzero(sample_step == k) for k in np.unique(sample_step)}
    mode, pushed = stages @ modes.inward.T, rate @ modes.inward.T
    pushed -= modes.rate_per_s * mode
    moved = 1 + max(
        int(turns.columns.max(initial=-1)), int(entry_column.max(initial=-1))
    )  # columns of parameters come first
    state: FloatArray = start
    shares = np.eye(n_columns - moved)
    turned = _Turned(modes, turns)
    inward, outward = (np.ascontiguousarray(matrix.T) for matrix in (modes.inward, modes.outward))
    at_s, keep, whole, late = np.nan, np.empty(n), np.empty(n), np.empty(n)
    divided, identity, at = np.empty((3, n, n)), np.eye(n), entry_column * n + entry_node
    least = FADED * float(np.abs(start[:, moved:]).max(initial=0.0))
    for k in range(n_steps):
        if step_s[k] != at_s:
            at_s = float(step_s[k])
            weights(at_s, modes.rate_per_s, keep, whole, late)
            early = whole - late
            turned_keep, turned_early, turned_late = ((inward * weight) @ outward for weight in (keep, early, late))
            if turns.columns.size > 0:
                divided_differences(at_s, modes.rate_per_s, keep, early, late, divided)
        backward = identity.copy()
        _add_changed(row, column, -entry[k, 1], turned_late, backward)
        first, last = (np.bincount(at, weights=entry_series[:, k, end], minlength=moved * n) for end in (0, 1))
        given = first.reshape(moved, n) @ inward * early + last.reshape(moved, n) @ inward * late
        if turns.columns.size > 0:
            mixed = divided[0] * mode[k, 0] + divided[1] * pushed[k, 0] + divided[2] * pushed[k, 1]
            mixed -= early[:, None] * mode[k, 0] + late[:, None] * mode[k, 1]
            turned.add(mixed, inward, given)
        forward = turned_keep.T @ state + turned_early.T @ _changed(row, column, entry[k, 0], state)
        forward[:, :moved] += (given @ outward).T
        state = np.asarray(np.linalg.solve(backward.T, forward), dtype=np.float64)
        if (k + 1).bit_count() == 1:  # at steps 1, 2, 4, ...: so often does it pay
            fading, left = _spanned(state[:, moved:], least)
            state, shares = np.hstack([state[:, :moved], fading]), left @ shares
        if k + 1 in samples:
            read = state[observed]
            out[samples[k + 1]] = np.hstack([read[:, :moved], read[:, moved:] @ shares])
    return out, np.hstack([state[:, :moved], state[:, moved:] @ shares])
