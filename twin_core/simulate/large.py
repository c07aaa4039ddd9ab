"""The derivatives of ``derivatives`` for networks of many nodes: the same formulas, carried out by BLAS and LAPACK.

The compiled loops are the quicker ones below some dozens of nodes; beyond, products of full matrices decide, and few are
needed in the modes of A, where a step of the linear part is one number per mode. What is left of the Jacobian beside A couples
few nodes as a rule: it takes products as narrow as these, and the implicit end of a step a matrix of their number (Woodbury). To
the columns of initial temperatures nothing is added: as the quick modes die out they span less and less, and what is carried on
is a basis of what is left.
"""

import numpy as np
from numba import njit
from scipy.linalg import qr

from twin_core._typing import FloatArray, IntArray
from twin_core.simulate.derivatives import mix, turn
from twin_core.simulate.modes import Modes, Turning, divided_differences, weights

MANY = 48
"""Nodes from which on this way is the quicker one."""

SPARSE = 0.2
"""Up to this share of n entries per column that changes A they are taken one by one: beyond, a product of full matrices is
quicker. Measured side by side on one core with 100 to 658 nodes and 30 or 100 columns: one by one takes 0.3 to 1.6 times as long
at a share of 0.1, 1.4 to 3 times at 0.3, 6 times at 1; with 6 columns full matrices are always the quicker way."""

FADED = 1e-12
"""What is smaller than this, beside the largest derivative by an initial temperature at the start, is no longer carried on."""


@njit(cache=True, nogil=True)
def _drive(
    column: IntArray,
    node: IntArray,
    first: FloatArray,
    last: FloatArray,
    inward: FloatArray,
    early: FloatArray,
    late: FloatArray,
    out: FloatArray,
) -> None:
    """Add what rates of the nodes (n_entries,) at both ends of a step do to the modes of each column, (n_columns, n)."""
    for e in range(column.size):
        for i in range(out.shape[1]):
            out[column[e], i] += (first[e] * early[i] + last[e] * late[i]) * inward[node[e], i]


def _spanned(columns: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """Return a basis of the columns, (n, rank), and their shares in it, (rank, n_columns); what is below ``least`` is nothing."""
    if columns.shape[1] == 0:
        return columns, np.zeros((0, 0))
    basis, triangle, order = qr(columns, mode="economic", pivoting=True, check_finite=False)
    rank = int(np.count_nonzero(np.abs(np.diag(triangle)) > least))
    shares = np.empty((rank, order.size))
    shares[:, order] = triangle[:rank]
    return basis[:, :rank], shares


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
        """Add sum_j (inward dA outward)[i, j] mixed[j, i] of every column to (n_columns, n); ``inward`` is transposed."""
        turns = self._turns
        if self._dense is not None:
            out[turns.columns] += (self._dense @ mixed.T[:, :, None])[:, :, 0].T
        else:
            turn(self._columns, turns.row, turns.column, turns.value, inward, self._outward @ mixed, out)


class _Beside:
    """What the Jacobian has beside A, in modes: the nodes that it couples, and entries that differ from step to step."""

    def __init__(self, modes: Modes, row: IntArray, column: IntArray) -> None:
        rows, row_at = np.unique(row, return_inverse=True)
        columns, column_at = np.unique(column, return_inverse=True)
        self._shape, self._at = (rows.size, columns.size), row_at * columns.size + column_at
        self._into = np.ascontiguousarray(modes.inward[:, rows])
        self._outof = np.ascontiguousarray(modes.outward[columns])

    def _matrix(self, entry: FloatArray) -> FloatArray:
        size = self._shape[0] * self._shape[1]
        return np.bincount(self._at, weights=entry, minlength=size).astype(np.float64, copy=False).reshape(self._shape)

    def coupled(self, state: FloatArray) -> FloatArray:
        """Return the temperatures of the nodes that it reads, (n_columns_read, n_columns), of states in modes."""
        return np.asarray(self._outof @ state)

    def times(self, entry: FloatArray, coupled: FloatArray) -> FloatArray:
        """Return its product with states whose ``coupled`` are known, in modes, (n, n_columns)."""
        return np.asarray(self._into @ (self._matrix(entry) @ coupled))

    def through(self, late: FloatArray) -> FloatArray:
        """Return what rates of the nodes that it drives do to those that it reads, by weights of the modes."""
        return np.asarray(self._outof @ (late[:, None] * self._into))

    def solved(
        self, entry: FloatArray, late: FloatArray, through: FloatArray, right: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return x with x = right + late * (this @ x), by Woodbury's formula, and what of it is coupled."""
        matrix = self._matrix(entry)
        coupled = np.linalg.solve(np.eye(self._shape[1]) - through @ matrix, self._outof @ right)
        return np.asarray(right + late[:, None] * (self._into @ (matrix @ coupled))), np.asarray(coupled)


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

    Arguments and result as of ``march_sensitivities``; the entries of ``turns`` are taken one by one where they are few.
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
    state: FloatArray = modes.inward @ start
    shares = np.eye(n_columns - moved)
    turned = _Turned(modes, turns)
    inward, reading = np.ascontiguousarray(modes.inward.T), np.ascontiguousarray(modes.outward[observed])
    at_s, keep, whole, late = np.nan, np.empty(n), np.empty(n), np.empty(n)
    divided, mixed = np.empty((3, n, n)), np.empty((n, n))
    beside = _Beside(modes, row, column)
    coupled, through = beside.coupled(state), np.empty((0, 0))
    series = np.ascontiguousarray(entry_series.transpose(1, 2, 0))
    least = FADED * float(np.abs(start[:, moved:]).max(initial=0.0))
    for k in range(n_steps):
        if step_s[k] != at_s:
            at_s = float(step_s[k])
            weights(at_s, modes.rate_per_s, keep, whole, late)
            early, through = whole - late, beside.through(late)
            if turns.columns.size > 0:
                divided_differences(at_s, modes.rate_per_s, keep, early, late, divided)
        given = np.zeros((moved, n))
        _drive(entry_column, entry_node, series[k, 0], series[k, 1], inward, early, late, given)
        if turns.columns.size > 0:
            mix(divided, early, late, mode[k], pushed[k], mixed)
            turned.add(mixed, inward, given)
        forward = keep[:, None] * state + early[:, None] * beside.times(entry[k, 0], coupled)
        forward[:, :moved] += given.T
        state, coupled = beside.solved(entry[k, 1], late, through, forward)
        if (k + 1).bit_count() == 1:  # at steps 1, 2, 4, ...: so often does it pay
            fading, left = _spanned(modes.outward @ state[:, moved:], least)
            state, shares = np.hstack([state[:, :moved], modes.inward @ fading]), left @ shares
            coupled = beside.coupled(state)
        if k + 1 in samples:
            read = reading @ state
            out[samples[k + 1]] = np.hstack([read[:, :moved], read[:, moved:] @ shares])
    end = modes.outward @ state
    return out, np.hstack([end[:, :moved], end[:, moved:] @ shares])
