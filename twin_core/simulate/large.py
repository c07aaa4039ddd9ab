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
    """Advance d state / d column along a trajectory without relays; arguments and result as of ``march_sensitivities``."""
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
    cells, place = np.unique(row * n + column, return_inverse=True)
    indices, pointers = cells % n, np.searchsorted(cells, np.arange(n + 1) * n)
    by_row = np.ascontiguousarray(turning.transpose(1, 0, 2))  # (n, n_turned, n)
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
        first, last = (
            csr_array(
                (np.bincount(place, weights=entry[k, side], minlength=indices.size), indices, pointers), shape=(n, n)
            )
            for side in (0, 1)
        )
        driven, reached = first @ state, np.zeros((n, fed.size))
        np.add.at(driven, (entry_node, entry_column), entry_series[:, k, 0])
        np.add.at(reached, (entry_node, among), entry_series[:, k, 1])
        work = dense_keep @ state + dense_early @ driven
        work[:, fed] += dense_late @ reached
        if turned.size > 0:
            mixed = divided[0] * mode[k, 0] + divided[1] * pushed[k, 0] + divided[2] * pushed[k, 1]
            mixed -= early[:, None] * mode[k, 0] + late[:, None] * mode[k, 1]
            work[:, turned] += modes.outward @ (by_row @ mixed[:, :, None])[:, :, 0]
        backward = np.eye(n) - (last.T @ dense_late.T).T
        state = lu_solve(lu_factor(backward, overwrite_a=True, check_finite=False), work, check_finite=False)
        if k + 1 in samples:
            out[samples[k + 1]] = state[observed]
    return out, state
