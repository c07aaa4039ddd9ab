"""The linear response along a trajectory, exact for the discrete scheme: to parameters, to the start, to further heats.

It is carried in the coordinate of the steps, enthalpy over own capacity (see ``Balance``): where C(T) is no constant, a
change of temperature dT counts as dT / (d T / d u), and a parameter of C(T) also changes what is stored at a temperature.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.dynamics import Balance, free_entries
from twin_core.network.model import Network
from twin_core.network.storage import store, to_enthalpy_K
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.kernels import Modes, march_sensitivities
from twin_core.simulate.rollout import Rollout
from twin_core.simulate.splitting import anchors, couplings, less_modes, modes_of, probe, symmetric, turning
from twin_core.simulate.stages import balance_along

Entries = tuple[IntArray, IntArray, FloatArray]
"""Which column, which node, and d (d u / d t) / d column at both ends of the steps, (n_entries, 2 n_steps)."""


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
    own = values[network.capacity_index]
    state = start_columns / store(network, values, trajectory.start_K[None]).slope[0][:, None]
    begin_K = trajectory.start_K
    if forcing.n_steps == 0:
        yield slice(0, forcing.sample_step.size), np.repeat(start_columns[None, observed], forcing.sample_step.size, 0)
    about_K, turned, turns = None, np.zeros(0, dtype=np.int64), np.zeros((0, own.size, own.size))
    for first, last, anchor in anchors(trajectory.stages_K[:, 0]):
        low = int(np.searchsorted(forcing.sample_step, first, side="left" if first == 0 else "right"))
        high = int(np.searchsorted(forcing.sample_step, last, side="right"))
        stages_K, step_s = trajectory.stages_K[first:last], forcing.step_s[first:last]
        if anchor is not about_K:
            about_K = anchor
            parts = couplings(network, values, probe(network, values, forcing, about_K))
            slope = symmetric(parts.slope_W_per_K(about_K))
            modes = modes_of(slope, own)
            turned, turns = turning(network, values, forcing, about_K, parts)
            turns = modes.inward @ (turns / own[:, None]) @ modes.outward
        balance = balance_along(network, values, forcing, stages_K, first, last, derivatives=True)
        entries = balance.entry_free, balance.entry_node, balance.entry_series
        if network.capacities:
            stored = _stored_entries(network, values, stages_K, step_s, begin_K)
            column, node, series = (np.concatenate(pair) for pair in zip(entries, stored, strict=True))
            entries = column, node, series
        samples = forcing.sample_step[low:high] - first
        stages = to_enthalpy_K(network, values, stages_K)
        split = _Split(modes, slope, turned, turns, stages)
        begin_slope = store(network, values, begin_K[None]).slope
        block, state = _march(balance, step_s, split, entries, state, begin_slope, samples, observed)
        yield slice(low, high), block
        begin_K = stages_K[-1, 1] if stages_K.size else begin_K


@dataclass(frozen=True)
class _Split:
    """A as it was in the rollout: its modes, C A, and which columns change it by how much, in modes."""

    modes: Modes
    slope_W_per_K: FloatArray
    turned: IntArray
    turns: FloatArray
    stages: FloatArray


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
    # No column changes a coupling, so that any A close by will do: that of the mean.
    mean = balance.jacobian.mean() * balance.own_J_per_K[:, None]
    slope = symmetric(mean)
    nothing = np.zeros(0, dtype=np.int64)
    split = _Split(
        modes_of(slope, balance.own_J_per_K),
        slope,
        nothing,
        np.zeros((0, n_nodes, n_nodes)),
        np.zeros((forcing.n_steps, 2, n_nodes)),
    )
    begin_slope = np.ones((1, n_nodes))
    block, _ = _march(balance, forcing.step_s, split, entries, still, begin_slope, forcing.sample_step, observed)
    return block


def _march(
    balance: Balance,
    step_s: FloatArray,
    split: _Split,
    entries: Entries,
    state: FloatArray,
    begin_slope: FloatArray,
    sample_step: IntArray,
    observed: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Carry columns of enthalpy (n_nodes, n_columns) through steps; return those of the samples' temperatures, the end's."""
    column, node, series = entries
    shape = (step_s.size, 2, state.shape[0])
    block, end = march_sensitivities(
        step_s,
        split.modes,
        *less_modes(balance.jacobian, split.slope_W_per_K, balance.own_J_per_K),
        split.stages,
        (balance.heat_W / balance.own_J_per_K).reshape(shape),
        split.turned,
        split.turns,
        column,
        node,
        series.reshape(column.size, step_s.size, 2),
        state,
        sample_step,
        observed,
    )
    if balance.moves:
        slope = np.concatenate([begin_slope, balance.slope[1::2]])
        block *= slope[sample_step][:, observed, None]
    return block, end


def _stored_entries(
    network: Network, values: FloatArray, stages_K: FloatArray, step_s: FloatArray, begin_K: FloatArray
) -> Entries:
    """Return what parameters of C(T) store at given temperatures as held rates: a step starts from less or more.

    What is carried is V = d u / d column less p, p = d u / d parameter at a temperature. A step adds
    phi_1(h A) (p_begin - p_end) to it: the answer to a rate of (p_begin - p_end) / h, held over the step.
    """
    n_steps = stages_K.shape[0]
    points = np.concatenate([begin_K[None], stages_K[:, 1]])
    free, node, stored = free_entries(network, values, store(network, values, points).entries, points.shape[0])
    series = np.repeat((stored[:, :-1] - stored[:, 1:]) / step_s, 2, axis=1)
    return free, node, series.reshape(free.size, 2 * n_steps)
