"""The exponential trapezoidal rule, compiled.

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
from twin_core.simulate.matrices import factorise, multiply, multiply_turned, solve_columns
from twin_core.simulate.modes import Modes, dense, weights
from twin_core.simulate.relays import N_KICK, Relays, is_recalled, shares_before, switch

STEP_K = 1e-10
"""The end of each step is iterated to this, a thousandth of what a rollout converges to."""

N_FIXED, N_NEWTON = 6, 40
CONTRACTION = 0.3
"""Fixed-point iterations that contract less than this, or take more, give way to Newton's method."""
LEAST_CONTRACTION = 1e-2
"""One that was better by chance promises no more than this for the next step."""


NOT_NEAR = np.zeros((0, 2, 0))
"""No states are known that are close by."""


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
    near: FloatArray,
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
    near : (n_steps, 2, n)
        States close by at the begin and the end of each step: how far they move is where the iteration of an end starts from.
        ``NOT_NEAR`` where none are known: then from how far the step before moved.
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
    multiply(modes.inward, state, mode)
    at_s, dense_s, bad, contraction = np.nan, np.nan, n_steps, 1.0
    inward, outward, right = modes.inward.T.copy(), modes.outward.T.copy(), np.empty(n)
    for k in range(n_steps):
        if not chained:
            state[:] = starts[k]
            multiply(modes.inward, state, mode)
        guess_share = step_s[k] / at_s if chained and k > 0 else 0.0
        if step_s[k] != at_s:
            at_s = step_s[k]
            weights(at_s, modes.rate_per_s, keep, whole, late)
            contraction = 1.0
        out[k, 0] = state
        for i in range(n):
            guess = near[k, 1, i] - near[k, 0, i] if near.shape[0] > 0 else guess_share * moved[i]
            ahead[i] = state[i] + (guess if np.isfinite(guess) else 0.0)
        for r in range(n_relays):
            shares[r] = shares_before(relays, r, state, at_s, kicks[k, r])
        settled = False
        for attempt in range(2):
            begin[:], end[:] = given[k, 0], given[k, 1]
            for r in range(n_relays):
                begin[relays.node[r]] += relays.rate[r] * kicks[k, r, 0]
                end[relays.node[r]] += relays.rate[r] * kicks[k, r, 1]
            _remainder(left, k, 0, begin, state, pushed)
            multiply_turned(inward, pushed, first_g)
            for i in range(n):
                base[i] = whole[i] * (modes.rate_per_s[i] * mode[i] + first_g[i]) - late[i] * first_g[i]
            settled, contraction = _fixed_point(
                inward, outward, left, k, late, end, state, base, contraction, ahead, pushed, right
            )
            if not settled:
                if at_s != dense_s:
                    dense_s = at_s
                    dense(modes.outward, late, modes.inward, dense_late)
                settled = _newton(modes, left, k, late, dense_late, end, state, base, lowest, highest, ahead)
                multiply(modes.inward, ahead - state, pushed)
            switched = False
            if attempt == 0 and settled:
                for r in range(n_relays):
                    node = relays.node[r]
                    if switch(relays, r, state[node], ahead[node], shares[r], kicks[k, r]):
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
            if is_recalled(relays, r, state, kicks[k, r]):
                ahead[relays.memory[r]] = relays.on[r] if shares[r] == 1.0 else relays.off[r]
                recalled = True
        if inside and not recalled:
            for i in range(n):
                mode[i] += pushed[i]
        else:
            multiply(modes.inward, ahead, mode)
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
    inward: FloatArray,
    outward: FloatArray,
    left: Remainder,
    k: int,
    late: FloatArray,
    given: FloatArray,
    state: FloatArray,
    base: FloatArray,
    contraction: float,
    ahead: FloatArray,
    pushed: FloatArray,
    right: FloatArray,
) -> tuple[bool, float]:
    """Correct the end of step k until it rests; return whether it does and by how much an iteration contracts.

    ``contraction`` is that of the step before (1 where unknown): it hardly moves. ``inward`` and ``outward`` are transposed;
    ``pushed`` is how far the modes have moved.
    """
    n, before = state.size, 0.0
    alone = left.linear.size + left.fourth.size + left.moving_row.size == 0
    for iteration in range(N_FIXED):
        _remainder(left, k, 1, given, ahead, right)
        multiply_turned(inward, right, pushed)
        for i in range(n):
            pushed[i] = base[i] + late[i] * pushed[i]
        multiply_turned(outward, pushed, right)
        change = 0.0
        for i in range(n):
            change = max(change, abs(state[i] + right[i] - ahead[i]))
            ahead[i] = state[i] + right[i]
        if iteration > 0:
            contraction = max(change / before, LEAST_CONTRACTION) if before > 0.0 else LEAST_CONTRACTION
        if alone or change * min(contraction, 1.0) < STEP_K:
            return True, contraction
        if iteration > 0 and not contraction < CONTRACTION:
            return False, 1.0
        before = change
    return False, 1.0


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
        multiply(modes.inward, right, pushed)
        for i in range(n):
            pushed[i] = base[i] + late[i] * pushed[i]
        multiply(modes.outward, pushed, right)
        for i in range(n):
            column[i, 0] = state[i] + right[i] - ahead[i]
            for j in range(n):
                lu[i, j] = 1.0 if i == j else 0.0
        _subtract_slope(left, k, ahead, dense_late, lu)
        factorise(lu, pivots)
        solve_columns(lu, pivots, column)
        change = 0.0
        for i in range(n):
            change = max(change, abs(column[i, 0]))
            ahead[i] = min(max(ahead[i] + column[i, 0], lowest[i]), highest[i])
        if not change >= STEP_K:
            return change < STEP_K
    return False
