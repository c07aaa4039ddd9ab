"""Compiled recursions over time: the exponential trapezoidal rule, its derivatives and its transition matrices.

With du/dt = A u + g(t, u) and g linear over a step of length h between its values at both ends,

    u_1 = u_0 + h phi_1(h A) (A u_0 + g_0) + h phi_2(h A) (g_1 - g_0),    phi_1(z) = (e^z - 1) / z,  phi_2(z) = (phi_1(z) - 1) / z

is the exponential collocation method with nodes 0 and 1 (Hochbruck and Ostermann 2005; 2010, section 2.2): exact for what A
holds and for inputs held or linear over the step, of second order in the rest. A is symmetric in the scale of the
capacities, so it is taken apart once into modes, and the phi functions of any step length are those of n numbers: irregular
sampling costs no matrix functions. Nothing here knows what a term is.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, IntArray

STEP_K = 1e-10
"""The end of each step is iterated to this, a thousandth of what a rollout converges to."""

N_FIXED, N_NEWTON = 6, 40
CONTRACTION = 0.3
"""Fixed-point iterations that contract less than this, or take more, give way to Newton's method."""


class Modes(NamedTuple):
    """A = outward diag(rate) inward.

    Attributes
    ----------
    rate_per_s : (n,)
    outward, inward : (n, n)
        From modes to states, and back.
    """

    rate_per_s: FloatArray
    outward: FloatArray
    inward: FloatArray


class Remainder(NamedTuple):
    """What is left of the rates beside A and what is given: f(u) = A u + given + r(u).

    Attributes
    ----------
    row, column : (n_linear,)
        Where ``linear`` stands: r_row += linear u_column.
    linear : (n_linear,)
    fourth_row, fourth_column, fourth
        The same for u_column^4, (n_fourth,).
    moving_row, moving_column : (n_moving,)
    moving : (n_steps, 2, n_moving)
        The same for entries that differ at the begin and the end of each step.
    """

    row: IntArray
    column: IntArray
    linear: FloatArray
    fourth_row: IntArray
    fourth_column: IntArray
    fourth: FloatArray
    moving_row: IntArray
    moving_column: IntArray
    moving: FloatArray


@njit(cache=True, nogil=True)
def phi(z: float) -> tuple[float, float, float, float]:
    """Return phi_0 = exp to phi_3: by Taylor's series of phi_3 where z is small, and phi_k = z phi_(k+1) + 1 / k!."""
    if abs(z) < 1.0:
        term, third = 1.0 / 6.0, 0.0
        for k in range(4, 22):
            third += term
            term *= z / k
        second = z * third + 0.5
        first = z * second + 1.0
        return z * first + 1.0, first, second, third
    zeroth = np.exp(z)
    first = (zeroth - 1.0) / z
    second = (first - 1.0) / z
    return zeroth, first, second, (second - 0.5) / z


@njit(cache=True, nogil=True)
def _weights(step_s: float, rate: FloatArray, keep: FloatArray, whole: FloatArray, late: FloatArray) -> None:
    """Write e^(h rate), h phi_1 and h phi_2 of every mode."""
    for i in range(rate.size):
        zeroth, first, second, _ = phi(step_s * rate[i])
        keep[i], whole[i], late[i] = zeroth, step_s * first, step_s * second


_NODES, _SHARES = np.polynomial.legendre.leggauss(6)
NEAR = 0.5
"""Arguments closer than this have their divided difference as the mean slope between them, by Gauss's rule: exact to
rounding, where the difference of values would cancel."""


@njit(cache=True, nogil=True)
def _divided(
    step_s: float, rate: FloatArray, keep: FloatArray, early: FloatArray, late: FloatArray, out: FloatArray
) -> None:
    """Write the divided differences of e^(h x), h (phi_1 - phi_2) and h phi_2 over all pairs of modes, (3, n, n).

    They are the derivatives of the matrix functions (Daleckii and Krein; Higham, Functions of Matrices, theorem 3.11).
    """
    n = rate.size
    for i in range(n):
        for j in range(i + 1):
            distance = step_s * (rate[i] - rate[j])
            if abs(distance) < NEAR:
                zeroth, first, second = 0.0, 0.0, 0.0
                for q in range(_NODES.size):
                    z = step_s * rate[j] + 0.5 * (1.0 + _NODES[q]) * distance
                    p0, p1, p2, p3 = phi(z)
                    zeroth += 0.5 * _SHARES[q] * p0
                    first += 0.5 * _SHARES[q] * (p1 - p2)
                    second += 0.5 * _SHARES[q] * (p2 - 2.0 * p3)
                out[0, i, j] = step_s * zeroth
                out[1, i, j] = step_s * step_s * (first - second)
                out[2, i, j] = step_s * step_s * second
            else:
                gap = rate[i] - rate[j]
                out[0, i, j] = (keep[i] - keep[j]) / gap
                out[1, i, j] = (early[i] - early[j]) / gap
                out[2, i, j] = (late[i] - late[j]) / gap
            for f in range(3):
                out[f, j, i] = out[f, i, j]


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
        if matrix[k, k] == 0.0:
            matrix[k, k] = np.nan  # singular: what follows is not finite, and says so
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


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _multiply(matrix: FloatArray, column: FloatArray, out: FloatArray) -> None:
    """Write matrix @ column to ``out``."""
    for i in range(matrix.shape[0]):
        total = 0.0
        for j in range(matrix.shape[1]):
            total += matrix[i, j] * column[j]
        out[i] = total


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _multiply_columns(matrix: FloatArray, columns: FloatArray, out: FloatArray) -> None:
    """Write matrix @ columns to ``out``."""
    out[:] = 0.0
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            factor = matrix[i, j]
            if factor != 0.0:
                for c in range(columns.shape[1]):
                    out[i, c] += factor * columns[j, c]


@njit(cache=True, nogil=True)
def _dense(outward: FloatArray, weight: FloatArray, inward: FloatArray, out: FloatArray) -> None:
    """Write outward diag(weight) inward to ``out``."""
    scaled = np.empty_like(inward)
    for i in range(weight.size):
        for j in range(weight.size):
            scaled[i, j] = weight[i] * inward[i, j]
    _multiply_columns(outward, scaled, out)


@njit(cache=True, nogil=True)
def _remainder(left: Remainder, k: int, side: int, given: FloatArray, state: FloatArray, out: FloatArray) -> None:
    """Write given + r(state) at one side of step k to ``out``."""
    out[:] = given
    for e in range(left.linear.size):
        out[left.row[e]] += left.linear[e] * state[left.column[e]]
    for e in range(left.fourth.size):
        square = state[left.fourth_column[e]] * state[left.fourth_column[e]]
        out[left.fourth_row[e]] += left.fourth[e] * (square * square)
    for e in range(left.moving_row.size):
        out[left.moving_row[e]] += left.moving[k, side, e] * state[left.moving_column[e]]


@njit(cache=True, nogil=True)
def _subtract_slope(left: Remainder, k: int, state: FloatArray, weight: FloatArray, matrix: FloatArray) -> None:
    """Subtract weight @ r'(state) at the end of step k from a matrix."""
    n = state.size
    for e in range(left.linear.size):
        for i in range(n):
            matrix[i, left.column[e]] -= weight[i, left.row[e]] * left.linear[e]
    for e in range(left.fourth.size):
        x = state[left.fourth_column[e]]
        slope = 4.0 * left.fourth[e] * (x * x * x)
        for i in range(n):
            matrix[i, left.fourth_column[e]] -= weight[i, left.fourth_row[e]] * slope
    for e in range(left.moving_row.size):
        for i in range(n):
            matrix[i, left.moving_column[e]] -= weight[i, left.moving_row[e]] * left.moving[k, 1, e]


@njit(cache=True, nogil=True)
def march(
    step_s: FloatArray,
    modes: Modes,
    left: Remainder,
    given: FloatArray,
    starts: FloatArray,
    lowest: FloatArray,
    highest: FloatArray,
) -> tuple[FloatArray, int]:
    """Advance the states; each step's end is corrected until it rests.

    Parameters
    ----------
    step_s : (n_steps,)
    modes
        Of A.
    left
        r(u).
    given : (n_steps, 2, n)
        Rates that no state changes, at the begin and the end of each step.
    starts : (1, n) or (n_steps, n)
        The initial state, or one for each step: then no step goes on from the one before.
    lowest, highest : (n,)
        States are kept within.

    Returns
    -------
    (n_steps, 2, n), int
        States at the begin and the end of each step, and the first step that left the limits or did not come to rest
        (n_steps where there is none). From the first that is not finite on, they are NaN.
    """
    n_steps, n = step_s.size, starts.shape[1]
    chained = starts.shape[0] == 1
    out = np.full((n_steps, 2, n), np.nan)
    keep, whole, late = np.empty(n), np.empty(n), np.empty(n)
    dense_late, lu, pivots = np.empty((n, n)), np.empty((n, n)), np.empty(n, dtype=np.int64)
    column = np.empty((n, 1))
    right, first_g, base, now_g, pushed = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    state, mode, ahead, moved = starts[0].copy(), np.empty(n), np.empty(n), np.zeros(n)
    _multiply(modes.inward, state, mode)
    at_s, dense_s, bad = np.nan, np.nan, n_steps
    alone = left.linear.size + left.fourth.size + left.moving_row.size == 0
    for k in range(n_steps):
        if not chained:
            state[:] = starts[k]
            _multiply(modes.inward, state, mode)
        guess_share = step_s[k] / at_s if chained and k > 0 else 0.0
        if step_s[k] != at_s:
            at_s = step_s[k]
            _weights(at_s, modes.rate_per_s, keep, whole, late)
        out[k, 0] = state
        _remainder(left, k, 0, given[k, 0], state, right)
        _multiply(modes.inward, right, first_g)
        for i in range(n):
            base[i] = whole[i] * (modes.rate_per_s[i] * mode[i] + first_g[i]) - late[i] * first_g[i]
            ahead[i] = state[i] + guess_share * moved[i]
        change, before, contraction, settled = np.inf, np.inf, 1.0, False
        for iteration in range(N_FIXED):
            _remainder(left, k, 1, given[k, 1], ahead, right)
            _multiply(modes.inward, right, now_g)
            for i in range(n):
                now_g[i] = base[i] + late[i] * now_g[i]
            _multiply(modes.outward, now_g, pushed)
            change = 0.0
            for i in range(n):
                change = max(change, abs(state[i] + pushed[i] - ahead[i]))
                ahead[i] = state[i] + pushed[i]
            if iteration > 0:
                contraction = change / before if before > 0.0 else 0.0
            if alone or change * min(contraction, 1.0) < STEP_K:
                settled = True
                break
            if contraction > CONTRACTION and iteration > 0:
                break
            before = change
        if not settled:
            if at_s != dense_s:
                dense_s = at_s
                _dense(modes.outward, late, modes.inward, dense_late)
            for i in range(n):
                if not np.isfinite(ahead[i]):
                    ahead[i] = state[i]
                ahead[i] = min(max(ahead[i], lowest[i]), highest[i])
            for _ in range(N_NEWTON):
                _remainder(left, k, 1, given[k, 1], ahead, right)
                _multiply(modes.inward, right, now_g)
                for i in range(n):
                    now_g[i] = base[i] + late[i] * now_g[i]
                _multiply(modes.outward, now_g, pushed)
                for i in range(n):
                    column[i, 0] = state[i] + pushed[i] - ahead[i]
                    for j in range(n):
                        lu[i, j] = 1.0 if i == j else 0.0
                _subtract_slope(left, k, ahead, dense_late, lu)
                _factorise(lu, pivots)
                _solve_columns(lu, pivots, column)
                change = 0.0
                for i in range(n):
                    change = max(change, abs(column[i, 0]))
                    ahead[i] = min(max(ahead[i] + column[i, 0], lowest[i]), highest[i])
                if not change >= STEP_K:
                    settled = change < STEP_K
                    break
            for i in range(n):
                pushed[i] = ahead[i] - state[i]
            _multiply(modes.inward, pushed, now_g)
        inside = settled
        for i in range(n):
            if not (ahead[i] > lowest[i] and ahead[i] < highest[i]):
                inside = False
                if not np.isfinite(ahead[i]):
                    return out, min(bad, k)
                ahead[i] = min(max(ahead[i], lowest[i]), highest[i])
        if inside:
            for i in range(n):
                mode[i] += now_g[i]
        else:
            bad = min(bad, k)
            _multiply(modes.inward, ahead, mode)
        for i in range(n):
            moved[i] = ahead[i] - state[i]
            state[i] = ahead[i]
        out[k, 1] = state
    return out, bad


@njit(cache=True, nogil=True)
def _add_product(weight: FloatArray, row: IntArray, column: IntArray, entry: FloatArray, out: FloatArray) -> None:
    """Add weight @ (the matrix with these entries) to ``out``."""
    for e in range(row.size):
        value = entry[e]
        if value != 0.0:
            for i in range(out.shape[0]):
                out[i, column[e]] += weight[i, row[e]] * value


@njit(cache=True, nogil=True)
def march_sensitivities(
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
    """Advance d state / d column along a trajectory: the exact derivative of the discrete scheme, that of A included.

    Parameters
    ----------
    step_s : (n_steps,)
    modes
        Of A.
    row, column : (n_entries,)
    entry : (n_steps, 2, n_entries)
        The Jacobian less A, at the begin and the end of each step.
    stages, rate : (n_steps, 2, n)
        The trajectory and f along it.
    turned : (n_turned,)
        Columns that change A.
    turning : (n_turned, n, n)
        By how much, inward dA outward.
    entry_column, entry_node : (n_series,)
    entry_series : (n_series, n_steps, 2)
        d f / d column at the same states.
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
    keep, whole, early, late = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    dense_keep, dense_early, dense_late = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    divided, mixed = np.empty((3, n, n)), np.empty((n, n))
    matrix, pivots = np.empty((n, n)), np.empty(n, dtype=np.int64)
    work, pushed = np.empty((n, n_columns)), np.empty(n)
    mode, g = np.empty((2, n)), np.empty((2, n))
    state = start.copy()
    sample, at_s = 0, np.nan
    while sample < sample_step.size and sample_step[sample] == 0:
        for o in range(observed.size):
            out[sample, o] = state[observed[o]]
        sample += 1
    for k in range(n_steps):
        if step_s[k] != at_s:
            at_s = step_s[k]
            _weights(at_s, modes.rate_per_s, keep, whole, late)
            early[:] = whole - late
            _dense(modes.outward, keep, modes.inward, dense_keep)
            _dense(modes.outward, early, modes.inward, dense_early)
            _dense(modes.outward, late, modes.inward, dense_late)
            if turned.size > 0:
                _divided(at_s, modes.rate_per_s, keep, early, late, divided)
        matrix[:] = dense_keep
        _add_product(dense_early, row, column, entry[k, 0], matrix)
        _multiply_columns(matrix, state, work)
        for e in range(entry_column.size):
            node, first, last = entry_node[e], entry_series[e, k, 0], entry_series[e, k, 1]
            if first != 0.0 or last != 0.0:
                for i in range(n):
                    work[i, entry_column[e]] += dense_early[i, node] * first + dense_late[i, node] * last
        if turned.size > 0:
            for side in range(2):
                _multiply(modes.inward, stages[k, side], mode[side])
                _multiply(modes.inward, rate[k, side], g[side])
                for i in range(n):
                    g[side, i] -= modes.rate_per_s[i] * mode[side, i]
            for i in range(n):
                for j in range(n):
                    mixed[i, j] = (
                        divided[0, i, j] * mode[0, j]
                        + divided[1, i, j] * g[0, j]
                        + divided[2, i, j] * g[1, j]
                        - early[i] * mode[0, j]
                        - late[i] * mode[1, j]
                    )
            for t in range(turned.size):
                for i in range(n):
                    total = 0.0
                    for j in range(n):
                        total += turning[t, i, j] * mixed[i, j]
                    pushed[i] = total
                for i in range(n):
                    total = 0.0
                    for j in range(n):
                        total += modes.outward[i, j] * pushed[j]
                    work[i, turned[t]] += total
        matrix[:] = 0.0
        _add_product(dense_late, row, column, entry[k, 1], matrix)
        for i in range(n):
            for j in range(n):
                matrix[i, j] = (1.0 if i == j else 0.0) - matrix[i, j]
        _factorise(matrix, pivots)
        _solve_columns(matrix, pivots, work)
        state[:] = work
        while sample < sample_step.size and sample_step[sample] == k + 1:
            for o in range(observed.size):
                out[sample, o] = state[observed[o]]
            sample += 1
    return out, state


@njit(cache=True, nogil=True)
def transitions(
    step_s: FloatArray, modes: Modes, row: IntArray, column: IntArray, entry: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return d end / d begin and d end / d a held rate of every step, (n_steps, n, n) each; arguments as above."""
    n_steps, n = step_s.size, modes.rate_per_s.size
    forward, response = np.empty((n_steps, n, n)), np.empty((n_steps, n, n))
    keep, whole, late = np.empty(n), np.empty(n), np.empty(n)
    dense_keep, dense_whole = np.empty((n, n)), np.empty((n, n))
    dense_early, dense_late = np.empty((n, n)), np.empty((n, n))
    matrix, pivots, both = np.empty((n, n)), np.empty(n, dtype=np.int64), np.empty((n, 2 * n))
    at_s = np.nan
    for k in range(n_steps):
        if step_s[k] != at_s:
            at_s = step_s[k]
            _weights(at_s, modes.rate_per_s, keep, whole, late)
            _dense(modes.outward, keep, modes.inward, dense_keep)
            _dense(modes.outward, whole, modes.inward, dense_whole)
            _dense(modes.outward, late, modes.inward, dense_late)
            dense_early[:] = dense_whole - dense_late
        matrix[:] = dense_keep
        _add_product(dense_early, row, column, entry[k, 0], matrix)
        both[:, :n], both[:, n:] = matrix, dense_whole
        matrix[:] = 0.0
        _add_product(dense_late, row, column, entry[k, 1], matrix)
        for i in range(n):
            for j in range(n):
                matrix[i, j] = (1.0 if i == j else 0.0) - matrix[i, j]
        _factorise(matrix, pivots)
        _solve_columns(matrix, pivots, both)
        forward[k], response[k] = both[:, :n], both[:, n:]
    return forward, response
