"""The exact derivatives of the exponential trapezoidal rule: sensitivities along a trajectory, and transition matrices."""

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, IntArray
from twin_core.simulate.matrices import factorise, multiply, product, solve_columns
from twin_core.simulate.modes import Modes, Turning, dense, divided_differences, weights
from twin_core.simulate.relays import Relays, is_recalled


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
        solve_columns(lu, pivots, out)


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
def mix(
    divided: FloatArray, early: FloatArray, late: FloatArray, mode: FloatArray, pushed: FloatArray, out: FloatArray
) -> None:
    """Write to [j, i] how the end of a step answers in mode i to a change of A from mode j to i, in one pass over memory.

    ``mode`` and ``pushed`` (2, n) are the modes at both ends of the step and f less A there.
    """
    for j in range(early.size):
        for i in range(early.size):
            out[j, i] = (
                (divided[0, j, i] - early[i]) * mode[0, j]
                + divided[1, j, i] * pushed[0, j]
                + divided[2, j, i] * pushed[1, j]
                - late[i] * mode[1, j]
            )


@njit(cache=True, nogil=True)
def turn(
    turned: IntArray,
    row: IntArray,
    column: IntArray,
    value: FloatArray,
    into: FloatArray,
    through: FloatArray,
    out: FloatArray,
) -> None:
    """Add what every entry of the dA does to the modes, to row ``turned`` of (n_columns, n).

    ``into`` is inward transposed, ``through`` outward times what ``mix`` writes.
    """
    for e in range(turned.size):
        t, first, second, factor = turned[e], row[e], column[e], value[e]
        for i in range(into.shape[1]):
            out[t, i] += factor * into[first, i] * through[second, i]


@njit(cache=True, nogil=True)
def _add_turned(
    turns: Turning,
    modes: Modes,
    into: FloatArray,
    outof: FloatArray,
    mixed: FloatArray,
    through: FloatArray,
    pushed: FloatArray,
    columns: FloatArray,
) -> None:
    """Add outward ((inward dA outward) * mixed^T) 1 of every column that changes A to its column of ``columns``, (n, n_columns).

    ``mixed`` is what ``mix`` writes; ``into`` and ``outof`` are inward and outward transposed, ``through`` (n, n) and ``pushed``
    (2, n_turned, n) are for its use. The dA are taken entry by entry, for a coupling has four of them.
    """
    n = into.shape[0]
    product(modes.outward, mixed, through)
    pushed[0] = 0.0
    turn(turns.which, turns.row, turns.column, turns.value, into, through, pushed[0])
    product(pushed[0], outof, pushed[1])
    for i in range(n):
        for t in range(turns.columns.size):
            columns[i, turns.columns[t]] += pushed[1, t, i]


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
    turns: Turning,
    lu: FloatArray,
    pivots: IntArray,
    n_columns: int,
) -> FloatArray:
    """Return what the end of a relay's node would answer more to the columns if the relay had not switched, (n_columns,)."""
    n, node = early.shape[0], relays.node[r]
    more = (kick[12] - kick[0], kick[13] - kick[1])
    columns, mixed = np.zeros((n, n_columns)), np.empty((n, n))
    for which in range(2, 4):
        if relay_column[which, r] >= 0:
            for i in range(n):
                by_rate = more[0] * early[i, node] + more[1] * late[i, node]
                columns[i, relay_column[which, r]] += relay_slope[which, r] * by_rate
    if turns.columns.size > 0:
        for j in range(n):
            for i in range(n):
                by_rate = more[0] * divided[1, j, i] + more[1] * divided[2, j, i]
                mixed[j, i] = by_rate * relays.rate[r] * modes.inward[j, node]
        into, outof = modes.inward.T.copy(), modes.outward.T.copy()
        through, pushed = np.empty((n, n)), np.empty((2, turns.columns.size, n))
        _add_turned(turns, modes, into, outof, mixed, through, pushed, columns)
    solve_columns(lu, pivots, columns)
    return columns[node].copy()


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
    turns: Turning,
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
    turns
        Which columns change A, and by how much: dA, not C dA.
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
    into, outof = modes.inward.T.copy(), modes.outward.T.copy()
    through, pushed = np.empty((n, n)), np.empty((2, turns.columns.size, n))
    work = np.empty((n, n_columns))
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
            weights(at_s, modes.rate_per_s, keep, whole, late)
            early[:] = whole - late
            dense(modes.outward, keep, modes.inward, dense_keep)
            dense(modes.outward, early, modes.inward, dense_early)
            dense(modes.outward, late, modes.inward, dense_late)
            if turns.columns.size > 0:
                divided_differences(at_s, modes.rate_per_s, keep, early, late, divided)
        matrix[:] = dense_keep
        _add_product(dense_early, row, column, entry[k, 0], matrix)
        product(matrix, state, work)
        for e in range(entry_column.size):
            node, first, last = entry_node[e], entry_series[e, k, 0], entry_series[e, k, 1]
            if first != 0.0 or last != 0.0:
                for i in range(n):
                    work[i, entry_column[e]] += dense_early[i, node] * first + dense_late[i, node] * last
        if turns.columns.size > 0:
            for side in range(2):
                multiply(modes.inward, stages[k, side], mode[side])
                multiply(modes.inward, rate[k, side], g[side])
                for i in range(n):
                    g[side, i] -= modes.rate_per_s[i] * mode[side, i]
            mix(divided, early, late, mode, g, mixed)
            _add_turned(turns, modes, into, outof, mixed, through, pushed, work)
        matrix[:] = 0.0
        _add_product(dense_late, row, column, entry[k, 1], matrix)
        for i in range(n):
            for j in range(n):
                matrix[i, j] = (1.0 if i == j else 0.0) - matrix[i, j]
        factorise(matrix, pivots)
        solve_columns(matrix, pivots, work)
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
                    turns,
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
            if is_recalled(relays, r, stages[k, 0], kicks[k, r]):
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
            weights(at_s, modes.rate_per_s, keep, whole, late)
            dense(modes.outward, keep, modes.inward, dense_keep)
            dense(modes.outward, whole, modes.inward, dense_whole)
            dense(modes.outward, late, modes.inward, dense_late)
            dense_early[:] = dense_whole - dense_late
        matrix[:] = dense_keep
        _add_product(dense_early, row, column, entry[k, 0], matrix)
        both[:, :n], both[:, n:] = matrix, dense_whole
        matrix[:] = 0.0
        _add_product(dense_late, row, column, entry[k, 1], matrix)
        for i in range(n):
            for j in range(n):
                matrix[i, j] = (1.0 if i == j else 0.0) - matrix[i, j]
        factorise(matrix, pivots)
        solve_columns(matrix, pivots, both)
        for r in range(relays.node.size):
            _answer(relays, r, kicks[k, r], dense_early, dense_late, matrix, pivots, vector)
            row_of = both[relays.node[r]].copy()
            for side in range(2):
                for i in range(n):
                    for c in range(2 * n):
                        both[i, c] += vector[i, side] * kicks[k, r, 10 + side] * row_of[c]
                    both[i, relays.memory[r]] += vector[i, side] * kicks[k, r, 2 + side]
                    both[i, relays.node[r]] += vector[i, side] * kicks[k, r, 4 + side]
            if is_recalled(relays, r, begins[k], kicks[k, r]):
                both[relays.memory[r]] = 0.0
        forward[k], response[k] = both[:, :n], both[:, n:]
    return forward, response
