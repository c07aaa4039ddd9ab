"""The linear response along a trajectory, exact for the discrete scheme: to parameters, to the start, to further heats.

It is carried in the coordinate of the steps, enthalpy over own capacity (see ``Balance``): where C(T) is no constant, a
change of temperature dT counts as dT / (d T / d u), and a parameter of C(T) also changes what is stored at a temperature.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.dynamics import Balance, free_entries
from twin_core.network.model import Network
from twin_core.network.storage import store
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.kernels import GAMMA, march_sensitivities
from twin_core.simulate.rollout import Rollout
from twin_core.simulate.stages import balance_along

Entries = tuple[IntArray, IntArray, FloatArray]
"""Which column, which node, and d (d u / d t) / d column at the stages, (n_entries, 2 n_steps)."""

STRETCH = 2048
"""Steps whose matrices are held at once."""


def sensitivities(
    network: Network,
    values: FloatArray,
    forcing: Forcing,
    trajectory: Rollout,
    start_columns: FloatArray,
    observed: IntArray,
) -> Iterator[tuple[slice, FloatArray]]:
    """Yield d observed state / d (free parameters, start columns) at the samples, stretch by stretch.

    Parameters
    ----------
    network, values, forcing, trajectory
        A converged rollout.
    start_columns : (n_nodes, n_columns)
        d start / d column: columns beyond the free parameters belong to the initial state.
    observed : (n_observed,)
        States wanted.

    Yields
    ------
    slice, (n_samples_here, n_observed, n_columns)
        Which samples, and their derivatives: exact for the discrete scheme.
    """
    state = start_columns / store(network, values, trajectory.start_K[None]).slope[0][:, None]
    begin_K = trajectory.start_K
    for first in range(0, max(forcing.n_steps, 1), STRETCH):
        last = min(first + STRETCH, forcing.n_steps)
        low = int(np.searchsorted(forcing.sample_step, first, side="left" if first == 0 else "right"))
        high = int(np.searchsorted(forcing.sample_step, last, side="right"))
        stages_K, step_s = trajectory.stages_K[first:last], forcing.step_s[first:last]
        balance = balance_along(network, values, forcing, stages_K, first, last, derivatives=True)
        entries = balance.entry_free, balance.entry_node, balance.entry_series
        if network.capacities:
            stored = _stored_entries(network, values, stages_K, step_s, begin_K)
            column, node, series = (np.concatenate(pair) for pair in zip(entries, stored, strict=True))
            entries = column, node, series
        samples = forcing.sample_step[low:high] - first
        begin_slope = store(network, values, begin_K[None]).slope
        block, state = _march(balance, step_s, entries, state, begin_slope, samples, observed)
        yield slice(low, high), block
        begin_K = stages_K[-1, 1] if stages_K.size else begin_K


def heat_response(
    balance: Balance,
    forcing: Forcing,
    heats: Sequence[tuple[int, int, FloatArray]],
    n_columns: int,
    observed: IntArray,
) -> FloatArray:
    """Return d observed state / d column at the samples, (n_samples, n_observed, n_columns): how heats move a trajectory.

    Parameters
    ----------
    balance, forcing
        The balance at all stages of the trajectory.
    heats
        Column, node and heat per unit of the column, (n_points,).
    n_columns
        How many columns there are.
    observed : (n_observed,)
        States wanted.
    """
    n_nodes = balance.own_J_per_K.size
    entries = (
        np.array([column for column, _, _ in heats], dtype=np.int64),
        np.array([node for _, node, _ in heats], dtype=np.int64),
        np.array([heat / balance.own_J_per_K[node] for _, node, heat in heats]).reshape(-1, 2 * forcing.n_steps),
    )
    still = np.zeros((n_nodes, n_columns))
    block, _ = _march(balance, forcing.step_s, entries, still, np.ones((1, n_nodes)), forcing.sample_step, observed)
    return block


def _march(
    balance: Balance,
    step_s: FloatArray,
    entries: Entries,
    state: FloatArray,
    begin_slope: FloatArray,
    sample_step: IntArray,
    observed: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Carry columns of enthalpy (n_nodes, n_columns) through steps; return those of the samples' temperatures, the end's."""
    n = state.shape[0]
    column, node, series = entries
    block, end = march_sensitivities(
        step_s,
        balance.jacobian.dense().reshape(-1, 2, n, n),
        column,
        node,
        series.reshape(column.size, step_s.size, 2),
        state,
        sample_step,
        observed,
        GAMMA,
    )
    if balance.moves:
        slope = np.concatenate([begin_slope, balance.slope[1::2]])
        block *= slope[sample_step][:, observed, None]
    return block, end


def _stored_entries(
    network: Network, values: FloatArray, stages_K: FloatArray, step_s: FloatArray, begin_K: FloatArray
) -> Entries:
    """Return what parameters of C(T) store at given temperatures as rates over each stage: a step starts from less or more.

    With p = d u / d parameter at a temperature, a stage reads V + p = V_x + p_x + gamma h (...), V what is carried.
    """
    n_steps, _, n_nodes = stages_K.shape
    points = np.concatenate([begin_K[None], stages_K.reshape(-1, n_nodes)])
    free, node, stored = free_entries(network, values, store(network, values, points).entries, points.shape[0])
    first, end, begin = stored[:, 1::2], stored[:, 2::2], stored[:, 0:-1:2]
    middle = begin + (1.0 - GAMMA) / GAMMA * (first - begin)
    series = np.stack([begin - first, middle - end], axis=2) / (GAMMA * step_s[:, None])
    return free, node, series.reshape(free.size, 2 * n_steps)
