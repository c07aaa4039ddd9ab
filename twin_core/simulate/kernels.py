"""Compiled recursions over time: a linear system per step, solved in place. Nothing here knows what a term is.

The scheme is the two-stage, stiffly accurate, L-stable SDIRK method of second order (Alexander 1977, gamma = 1 - 1/sqrt 2):

    Y = x + gamma h f(t + gamma h, Y)
    z = x + (1 - gamma)/gamma (Y - x) + gamma h f(t + h, z)

With f linearised about a guess, f(Y) = g + J Y, each stage is one solve with I - gamma h J. L-stability keeps a rollout
bounded whatever step the telemetry forces; inputs held over a step are seen exactly. The Jacobian of a network hardly
moves: conductances are the same everywhere, radiation changes some diagonal entries. One factorisation serves many steps.
"""

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, IntArray

GAMMA = 1.0 - 1.0 / np.sqrt(2.0)

LINEAR_K = 1e-10
"""Each linear solve is iterated to this, a thousandth of what a rollout converges to."""

N_SOLVES = 4
"""Iterations after which a new inverse is cheaper."""


@njit(cache=True, nogil=True)
def _factorise(matrix: FloatArray, pivots: IntArray) -> None:
    """Replace a square matrix by its LU factors with partial pivoting."""
    n = matrix.shape[0]
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[best, k]):
                best = i
        pivots[k] = best
        if best != k:
            for j in range(n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
        for i in range(k + 1, n):
            if matrix[i, k] != 0.0:
                factor = matrix[i, k] / matrix[k, k]
                matrix[i, k] = factor
                for j in range(k + 1, n):
                    matrix[i, j] -= factor * matrix[k, j]


@njit(cache=True, nogil=True)
def _solve_columns(lu: FloatArray, pivots: IntArray, columns: FloatArray) -> None:
    """Solve in place for every column of (n, n_columns)."""
    n, n_columns = columns.shape
    for k in range(n):
        best = pivots[k]
        if best != k:
            for c in range(n_columns):
                columns[k, c], columns[best, c] = columns[best, c], columns[k, c]
    for i in range(n):
        for j in range(i):
            factor = lu[i, j]
            if factor != 0.0:
                for c in range(n_columns):
                    columns[i, c] -= factor * columns[j, c]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            factor = lu[i, j]
            if factor != 0.0:
                for c in range(n_columns):
                    columns[i, c] -= factor * columns[j, c]
        inverse = 1.0 / lu[i, i]
        for c in range(n_columns):
            columns[i, c] *= inverse


@njit(cache=True, nogil=True)
def _prepare(lu: FloatArray, pivots: IntArray, scaled_step: float, jacobian: FloatArray) -> None:
    """Factorise I - gamma h J."""
    n = jacobian.shape[0]
    for i in range(n):
        for j in range(n):
            lu[i, j] = -scaled_step * jacobian[i, j]
        lu[i, i] += 1.0
    _factorise(lu, pivots)


@njit(cache=True, nogil=True)
def _invert(inverse: FloatArray, scaled_step: float, jacobian: FloatArray) -> None:
    """Replace ``inverse`` by that of I - gamma h J."""
    n = jacobian.shape[0]
    lu, pivots = np.empty((n, n)), np.empty(n, dtype=np.int64)
    _prepare(lu, pivots, scaled_step, jacobian)
    inverse[:] = np.eye(n)
    _solve_columns(lu, pivots, inverse)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _multiply(matrix: FloatArray, column: FloatArray, out: FloatArray) -> None:
    """Write matrix @ column to ``out``."""
    for i in range(matrix.shape[0]):
        total = 0.0
        for j in range(matrix.shape[1]):
            total += matrix[i, j] * column[j]
        out[i] = total


@njit(cache=True, nogil=True)
def _solve_near(
    inverse: FloatArray, row: IntArray, column: IntArray, moved: FloatArray, right: FloatArray, out: FloatArray
) -> bool:
    """Solve (A - D) z = r by A z' = r + D z, A by its inverse and D by its entries; False where that takes long."""
    _multiply(inverse, right, out)
    before, now = np.zeros(right.size), np.empty(right.size)
    for _ in range(N_SOLVES):
        now[:] = 0.0
        for e in range(row.size):
            now[row[e]] += moved[e] * out[column[e]]
        if np.abs(now - before).max() < LINEAR_K:
            return True
        before[:] = now
        _multiply(inverse, right + now, out)
    return False


@njit(cache=True, nogil=True)
def march(
    step_s: FloatArray,
    constant: FloatArray,
    row: IntArray,
    column: IntArray,
    moving: FloatArray,
    rate: FloatArray,
    stages: FloatArray,
    start: FloatArray,
    gamma: float,
) -> FloatArray:
    """Advance the balance linearised about some stage states.

    One inverse serves as long as the step stays and the moving entries of the Jacobian stay near: what they have moved
    by is iterated, each iteration as dear as a product.

    Parameters
    ----------
    step_s : (n_steps,)
    constant : (n, n)
        The part of the Jacobian that no stage changes.
    row, column : (n_entries,)
    moving : (n_steps, 2, n_entries)
        What each stage adds to it, and where.
    rate : (n_steps, 2, n)
        f at ``stages``.
    stages : (n_steps, 2, n)
        Where the balance was linearised.
    start : (n,)
    gamma
        The scheme's constant.

    Returns
    -------
    (n_steps, 2, n)
        Stage states; the second is the state at the end of the step.
    """
    n_steps, n = step_s.size, start.size
    out = np.empty((n_steps, 2, n))
    inverse, inverted_at = np.empty((n, n)), np.nan
    reference = np.zeros(row.size)
    state = start.copy()
    right, change = np.empty(n), np.empty(n)
    ratio = (1.0 - gamma) / gamma
    for k in range(n_steps):
        scaled = gamma * step_s[k]
        for stage in range(2):
            for i in range(n):
                before = state[i] if stage == 0 else state[i] + ratio * (out[k, 0, i] - state[i])
                right[i] = before + scaled * rate[k, stage, i] - stages[k, stage, i]
            here = moving[k, stage]
            near = scaled == inverted_at and _solve_near(
                inverse, row, column, scaled * (here - reference), right, change
            )
            if not near:
                jacobian = constant.copy()
                for e in range(row.size):
                    jacobian[row[e], column[e]] += here[e]
                _invert(inverse, scaled, jacobian)
                reference[:], inverted_at = here, scaled
                _multiply(inverse, right, change)
            for i in range(n):
                out[k, stage, i] = stages[k, stage, i] + change[i]
        for i in range(n):
            state[i] = out[k, 1, i]
    return out


@njit(cache=True, nogil=True)
def march_sensitivities(
    step_s: FloatArray,
    jacobian: FloatArray,
    entry_column: IntArray,
    entry_node: IntArray,
    entry_series: FloatArray,
    start: FloatArray,
    sample_step: IntArray,
    observed: IntArray,
    gamma: float,
) -> tuple[FloatArray, FloatArray]:
    """Advance d state / d column along a trajectory: the exact derivative of the discrete scheme.

    Parameters
    ----------
    step_s : (n_steps,)
    jacobian : (n_steps, 2, n, n)
    entry_column, entry_node : (n_entries,)
    entry_series : (n_entries, n_steps, 2)
        d rate / d column at the stages.
    start : (n, n_columns)
    sample_step : (n_samples,)
        Number of steps taken before each sample, not decreasing; 0 is the start.
    observed : (n_observed,)
        States to be returned.

    Returns
    -------
    (n_samples, n_observed, n_columns), (n, n_columns)
        The observed sensitivities at the samples, and all of them at the end.
    """
    n_steps, n, n_columns = step_s.size, start.shape[0], start.shape[1]
    out = np.empty((sample_step.size, observed.size, n_columns))
    lu = np.empty((n, n))
    pivots = np.empty(n, dtype=np.int64)
    state = start.copy()
    first = np.empty((n, n_columns))
    work = np.empty((n, n_columns))
    ratio = (1.0 - gamma) / gamma
    sample = 0
    while sample < sample_step.size and sample_step[sample] == 0:
        for o in range(observed.size):
            out[sample, o] = state[observed[o]]
        sample += 1
    for k in range(n_steps):
        scaled = gamma * step_s[k]
        for stage in range(2):
            _prepare(lu, pivots, scaled, jacobian[k, stage])
            if stage == 0:
                work[:] = state
            else:
                for i in range(n):
                    for c in range(n_columns):
                        work[i, c] = state[i, c] + ratio * (first[i, c] - state[i, c])
            for e in range(entry_column.size):
                work[entry_node[e], entry_column[e]] += scaled * entry_series[e, k, stage]
            _solve_columns(lu, pivots, work)
            if stage == 0:
                first[:] = work
        state[:] = work
        while sample < sample_step.size and sample_step[sample] == k + 1:
            for o in range(observed.size):
                out[sample, o] = state[observed[o]]
            sample += 1
    return out, state
