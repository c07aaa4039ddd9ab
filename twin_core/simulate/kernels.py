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


class Relays(NamedTuple):
    """Heats that a state switches, (n_relays,) each.

    Attributes
    ----------
    node, memory
        The state that switches it, and the one that remembers it.
    low, high
        On below, off above.
    rate
        What it adds to the rate of ``node`` at full power.
    off, on
        The memory where it is off and on.
    approach
        How fast the node comes to a threshold.
    """

    node: IntArray
    memory: IntArray
    low: FloatArray
    high: FloatArray
    rate: FloatArray
    off: FloatArray
    on: FloatArray
    approach: FloatArray


N_KICK = 22
"""Columns of what ``march`` tells of each relay and step: its shares of full power at the begin and the end of the step; the
slopes of both with the memory (2, 3), the node at the begin (4, 5), the low (6, 7) and the high threshold (8, 9) and the node
at the end of the step as it were without a switch (10, 11). From 12 on, the first ten as they were without one."""

UNSETTLED = 0.02
"""A memory this near to off or on, as a share of the way between, is off or on."""


@njit(cache=True, nogil=True)
def _before(relays: Relays, r: int, state: FloatArray, step_s: float, kick: FloatArray) -> float:
    """Tell a relay's shares unless a threshold is passed in the step; return the share in force at its end."""
    kick[:] = 0.0
    slope = (1.0 + UNSETTLED) / (relays.on[r] - relays.off[r])
    share = slope * (state[relays.memory[r]] - relays.off[r]) - 0.5 * UNSETTLED
    if share <= 0.0 or share >= 1.0:
        slope, share = 0.0, min(max(share, 0.0), 1.0)
    here = state[relays.node[r]]
    if relays.low[r] <= here <= relays.high[r]:
        kick[0], kick[1], kick[2], kick[3] = share, share, slope, slope
        return share
    now = 1.0 if here < relays.low[r] else 0.0
    reach = max(relays.approach[r] * step_s, LEAST_TRAVEL)
    beyond = relays.low[r] - here if now == 1.0 else here - relays.high[r]
    passed, gap = min(beyond / reach, 1.0), now - share
    kick[0], kick[1], kick[2] = share + gap * passed, now, (1.0 - passed) * slope
    if passed < 1.0:
        sign = 1.0 if now == 1.0 else -1.0
        kick[4] = -sign * gap / reach
        kick[6 if now == 1.0 else 8] = sign * gap / reach
    return now


@njit(cache=True, nogil=True)
def _switch(relays: Relays, r: int, begin: float, end: float, share: float, kick: FloatArray) -> bool:
    """Tell a relay's shares where the step passes a threshold; return whether it does.

    The instant s is told by the chord of the step without a switch. The heat from it on enters as the straight line with its
    mean and first moment over the step: what it adds is (1 - s)(1 - 3 s) at the begin and (1 - s)(1 + 3 s) at the end.
    """
    if end < relays.low[r] and share < 1.0 and begin >= relays.low[r]:
        now, threshold, column = 1.0, relays.low[r], 6
    elif end > relays.high[r] and share > 0.0 and begin <= relays.high[r]:
        now, threshold, column = 0.0, relays.high[r], 8
    else:
        return False
    kick[12:] = kick[:10]
    travel, gap = end - begin, now - share
    s = (threshold - begin) / travel
    by_s = (gap * (6.0 * s - 4.0), gap * (2.0 - 6.0 * s))
    shares = ((1.0 - s) * (1.0 - 3.0 * s), (1.0 - s) * (1.0 + 3.0 * s))
    for side in range(2):
        kick[side] += gap * shares[side]
        kick[2 + side] *= 1.0 - shares[side]
        kick[4 + side] -= by_s[side] * (1.0 - s) / travel
        kick[column + side] += by_s[side] / travel
        kick[10 + side] -= by_s[side] * s / travel
    return True


LEAST_TRAVEL = 0.005
"""A state that moves less over a step counts as moving this far where its way tells an instant, in K."""


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
    relays: Relays,
    given: FloatArray,
    starts: FloatArray,
    lowest: FloatArray,
    highest: FloatArray,
) -> tuple[FloatArray, FloatArray, int]:
    """Advance the states; each step's end is corrected until it rests.

    Parameters
    ----------
    step_s : (n_steps,)
    modes
        Of A.
    left
        r(u).
    relays
        Each switches within the step in which its state passes a threshold.
    given : (n_steps, 2, n)
        Rates that no state changes, at the begin and the end of each step.
    starts : (1, n) or (n_steps, n)
        The initial state, or one for each step: then no step goes on from the one before.
    lowest, highest : (n,)
        States are kept within.

    Returns
    -------
    (n_steps, 2, n), (n_steps, n_relays, N_KICK), int
        States at the begin and the end of each step; what each relay did; and the first step that left the limits or did not
        come to rest (n_steps where there is none). From the first that is not finite on, the states are NaN.
    """
    n_steps, n, n_relays = step_s.size, starts.shape[1], relays.node.size
    chained = starts.shape[0] == 1
    out, kicks = np.full((n_steps, 2, n), np.nan), np.zeros((n_steps, n_relays, N_KICK))
    keep, whole, late = np.empty(n), np.empty(n), np.empty(n)
    dense_late = np.empty((n, n))
    first_g, base, ahead, moved = np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
    begin, end, pushed, shares = np.empty(n), np.empty(n), np.empty(n), np.empty(n_relays)
    state, mode = starts[0].copy(), np.empty(n)
    _multiply(modes.inward, state, mode)
    at_s, dense_s, bad = np.nan, np.nan, n_steps
    for k in range(n_steps):
        if not chained:
            state[:] = starts[k]
            _multiply(modes.inward, state, mode)
        guess_share = step_s[k] / at_s if chained and k > 0 else 0.0
        if step_s[k] != at_s:
            at_s = step_s[k]
            _weights(at_s, modes.rate_per_s, keep, whole, late)
        out[k, 0] = state
        for i in range(n):
            ahead[i] = state[i] + guess_share * moved[i]
        for r in range(n_relays):
            shares[r] = _before(relays, r, state, at_s, kicks[k, r])
        settled = False
        for attempt in range(2):
            begin[:], end[:] = given[k, 0], given[k, 1]
            for r in range(n_relays):
                begin[relays.node[r]] += relays.rate[r] * kicks[k, r, 0]
                end[relays.node[r]] += relays.rate[r] * kicks[k, r, 1]
            _remainder(left, k, 0, begin, state, pushed)
            _multiply(modes.inward, pushed, first_g)
            for i in range(n):
                base[i] = whole[i] * (modes.rate_per_s[i] * mode[i] + first_g[i]) - late[i] * first_g[i]
            settled = _fixed_point(modes, left, k, late, end, state, base, ahead, pushed)
            if not settled:
                if at_s != dense_s:
                    dense_s = at_s
                    _dense(modes.outward, late, modes.inward, dense_late)
                settled = _newton(modes, left, k, late, dense_late, end, state, base, lowest, highest, ahead)
                _multiply(modes.inward, ahead - state, pushed)
            switched = False
            if attempt == 0 and settled:
                for r in range(n_relays):
                    node = relays.node[r]
                    if _switch(relays, r, state[node], ahead[node], shares[r], kicks[k, r]):
                        switched = True
                        shares[r] = 1.0 if ahead[node] < relays.low[r] else 0.0
            if not switched:
                break
        inside = settled
        for i in range(n):
            if not np.isfinite(ahead[i]):
                return out, kicks, min(bad, k)
            if not (ahead[i] > lowest[i] and ahead[i] < highest[i]):
                inside = False
                ahead[i] = min(max(ahead[i], lowest[i]), highest[i])
        recalled = False
        for r in range(n_relays):
            if _recalled(relays, r, state, kicks[k, r]):
                ahead[relays.memory[r]] = relays.on[r] if shares[r] == 1.0 else relays.off[r]
                recalled = True
        if inside and not recalled:
            for i in range(n):
                mode[i] += pushed[i]
        else:
            _multiply(modes.inward, ahead, mode)
        if not inside:
            bad = min(bad, k)
        for i in range(n):
            moved[i] = ahead[i] - state[i]
            state[i] = ahead[i]
        for r in range(n_relays):
            moved[relays.memory[r]] = 0.0
        out[k, 1] = state
    return out, kicks, bad


@njit(cache=True, nogil=True)
def _fixed_point(
    modes: Modes,
    left: Remainder,
    k: int,
    late: FloatArray,
    given: FloatArray,
    state: FloatArray,
    base: FloatArray,
    ahead: FloatArray,
    pushed: FloatArray,
) -> bool:
    """Correct the end of step k until it rests; False where that takes long. ``pushed`` is how far its modes have moved."""
    n = state.size
    right, change, before = np.empty(n), np.inf, np.inf
    alone = left.linear.size + left.fourth.size + left.moving_row.size == 0
    for iteration in range(N_FIXED):
        _remainder(left, k, 1, given, ahead, right)
        _multiply(modes.inward, right, pushed)
        for i in range(n):
            pushed[i] = base[i] + late[i] * pushed[i]
        _multiply(modes.outward, pushed, right)
        change = 0.0
        for i in range(n):
            change = max(change, abs(state[i] + right[i] - ahead[i]))
            ahead[i] = state[i] + right[i]
        contraction = 1.0 if iteration == 0 else (change / before if before > 0.0 else 0.0)
        if alone or change * min(contraction, 1.0) < STEP_K:
            return True
        if not (iteration == 0 or contraction < CONTRACTION):
            return False
        before = change
    return False


@njit(cache=True, nogil=True)
def _newton(
    modes: Modes,
    left: Remainder,
    k: int,
    late: FloatArray,
    dense_late: FloatArray,
    given: FloatArray,
    state: FloatArray,
    base: FloatArray,
    lowest: FloatArray,
    highest: FloatArray,
    ahead: FloatArray,
) -> bool:
    """Solve for the end of step k by Newton's method; False where that takes long."""
    n = state.size
    right, pushed, column = np.empty(n), np.empty(n), np.empty((n, 1))
    lu, pivots = np.empty((n, n)), np.empty(n, dtype=np.int64)
    for i in range(n):
        if not np.isfinite(ahead[i]):
            ahead[i] = state[i]
        ahead[i] = min(max(ahead[i], lowest[i]), highest[i])
    for _ in range(N_NEWTON):
        _remainder(left, k, 1, given, ahead, right)
        _multiply(modes.inward, right, pushed)
        for i in range(n):
            pushed[i] = base[i] + late[i] * pushed[i]
        _multiply(modes.outward, pushed, right)
        for i in range(n):
            column[i, 0] = state[i] + right[i] - ahead[i]
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
            return change < STEP_K
    return False


@njit(cache=True, nogil=True)
def _add_product(weight: FloatArray, row: IntArray, column: IntArray, entry: FloatArray, out: FloatArray) -> None:
    """Add weight @ (the matrix with these entries) to ``out``."""
    for e in range(row.size):
        value = entry[e]
        if value != 0.0:
            for i in range(out.shape[0]):
                out[i, column[e]] += weight[i, row[e]] * value


@njit(cache=True, nogil=True)
def _answer(
    relays: Relays,
    r: int,
    kick: FloatArray,
    early: FloatArray,
    late: FloatArray,
    lu: FloatArray,
    pivots: IntArray,
    out: FloatArray,
) -> None:
    """Write how the end of a step answers to a relay's shares at its begin and end, (n, 2)."""
    for i in range(out.shape[0]):
        out[i, 0] = relays.rate[r] * early[i, relays.node[r]]
        out[i, 1] = relays.rate[r] * late[i, relays.node[r]]
    if np.any(kick[2:12] != 0.0):
        _solve_columns(lu, pivots, out)


@njit(cache=True, nogil=True)
def _shares(
    relays: Relays,
    r: int,
    kick: FloatArray,
    relay_column: IntArray,
    relay_slope: FloatArray,
    state: FloatArray,
    out: FloatArray,
) -> None:
    """Write how a relay's shares at both ends of a step answer to the columns by memory, begin and thresholds, (2, n_columns)."""
    for side in range(2):
        out[side] = kick[2 + side] * state[relays.memory[r]] + kick[4 + side] * state[relays.node[r]]
        for which in range(2):
            if relay_column[which, r] >= 0:
                out[side, relay_column[which, r]] += kick[6 + 2 * which + side] * relay_slope[which, r]


@njit(cache=True, nogil=True)
def _unswitched(
    modes: Modes,
    relays: Relays,
    r: int,
    kick: FloatArray,
    early: FloatArray,
    late: FloatArray,
    relay_column: IntArray,
    relay_slope: FloatArray,
    divided: FloatArray,
    turned: IntArray,
    turning: FloatArray,
    lu: FloatArray,
    pivots: IntArray,
    n_columns: int,
) -> FloatArray:
    """Return what the end of a relay's node would answer more to the columns if the relay had not switched, (n_columns,)."""
    n, node = early.shape[0], relays.node[r]
    more = (kick[12] - kick[0], kick[13] - kick[1])
    columns, pushed = np.zeros((n, n_columns)), np.empty(n)
    for which in range(2, 4):
        if relay_column[which, r] >= 0:
            for i in range(n):
                by_rate = more[0] * early[i, node] + more[1] * late[i, node]
                columns[i, relay_column[which, r]] += relay_slope[which, r] * by_rate
    for t in range(turned.size):
        for i in range(n):
            pushed[i] = 0.0
            for j in range(n):
                by_rate = more[0] * divided[1, i, j] + more[1] * divided[2, i, j]
                pushed[i] += turning[t, i, j] * by_rate * relays.rate[r] * modes.inward[j, node]
        for i in range(n):
            for j in range(n):
                columns[i, turned[t]] += modes.outward[i, j] * pushed[j]
    _solve_columns(lu, pivots, columns)
    return columns[node].copy()


@njit(cache=True, nogil=True)
def _recalled(relays: Relays, r: int, begin: FloatArray, kick: FloatArray) -> bool:
    """Return whether a relay's memory was set in a step: its threshold lay behind, or was passed."""
    inside = relays.low[r] <= begin[relays.node[r]] <= relays.high[r]
    return not inside or kick[10] != 0.0 or kick[11] != 0.0


@njit(cache=True, nogil=True)
def march_sensitivities(
    step_s: FloatArray,
    modes: Modes,
    row: IntArray,
    column: IntArray,
    entry: FloatArray,
    stages: FloatArray,
    rate: FloatArray,
    relays: Relays,
    kicks: FloatArray,
    relay_column: IntArray,
    relay_slope: FloatArray,
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
    relays, kicks
        The relays, and what ``march`` tells of them.
    relay_column, relay_slope : (4, n_relays)
        Which columns the low and the high threshold and the rate depend on, the last by its power and by the capacity (-1 for
        none), and how.
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
    vector, responses = np.empty((n, 2)), np.empty((2, n_columns))
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
        for r in range(relays.node.size):
            kick, node = kicks[k, r], relays.node[r]
            _answer(relays, r, kick, dense_early, dense_late, matrix, pivots, vector)
            without = work[node].copy()  # how the node would end without a switch
            if kick[10] != 0.0 or kick[11] != 0.0:
                without += _unswitched(
                    modes,
                    relays,
                    r,
                    kick,
                    dense_early,
                    dense_late,
                    relay_column,
                    relay_slope,
                    divided,
                    turned,
                    turning,
                    matrix,
                    pivots,
                    n_columns,
                )
                _shares(relays, r, kick[12:], relay_column, relay_slope, state, responses)
                without += vector[node, 0] * responses[0] + vector[node, 1] * responses[1]
            _shares(relays, r, kick[:10], relay_column, relay_slope, state, responses)
            for side in range(2):
                responses[side] += kick[10 + side] * without
            for i in range(n):
                for c in range(n_columns):
                    work[i, c] += vector[i, 0] * responses[0, c] + vector[i, 1] * responses[1, c]
            if _recalled(relays, r, stages[k, 0], kicks[k, r]):
                work[relays.memory[r]] = 0.0
        state[:] = work
        while sample < sample_step.size and sample_step[sample] == k + 1:
            for o in range(observed.size):
                out[sample, o] = state[observed[o]]
            sample += 1
    return out, state


@njit(cache=True, nogil=True)
def transitions(
    step_s: FloatArray,
    modes: Modes,
    row: IntArray,
    column: IntArray,
    entry: FloatArray,
    begins: FloatArray,
    relays: Relays,
    kicks: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return d end / d begin and d end / d a held rate of every step, (n_steps, n, n) each.

    Arguments as above; ``begins`` (n_steps, n) are the states before each step.
    """
    n_steps, n = step_s.size, modes.rate_per_s.size
    forward, response = np.empty((n_steps, n, n)), np.empty((n_steps, n, n))
    keep, whole, late = np.empty(n), np.empty(n), np.empty(n)
    dense_keep, dense_whole = np.empty((n, n)), np.empty((n, n))
    dense_early, dense_late = np.empty((n, n)), np.empty((n, n))
    matrix, pivots, both = np.empty((n, n)), np.empty(n, dtype=np.int64), np.empty((n, 2 * n))
    vector = np.empty((n, 2))
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
        for r in range(relays.node.size):
            _answer(relays, r, kicks[k, r], dense_early, dense_late, matrix, pivots, vector)
            row_of = both[relays.node[r]].copy()
            for side in range(2):
                for i in range(n):
                    for c in range(2 * n):
                        both[i, c] += vector[i, side] * kicks[k, r, 10 + side] * row_of[c]
                    both[i, relays.memory[r]] += vector[i, side] * kicks[k, r, 2 + side]
                    both[i, relays.node[r]] += vector[i, side] * kicks[k, r, 4 + side]
            if _recalled(relays, r, begins[k], kicks[k, r]):
                both[relays.memory[r]] = 0.0
        forward[k], response[k] = both[:, :n], both[:, n:]
    return forward, response
