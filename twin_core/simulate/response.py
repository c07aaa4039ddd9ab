"""The linear response along a trajectory, exact for the discrete scheme: to parameters, to the start, to further heats.

It is carried in the coordinate of the steps, enthalpy over own capacity (see ``Balance``): where C(T) is no constant, a
change of temperature dT counts as dT / (d T / d u), and a parameter of C(T) also changes what is stored at a temperature.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.dynamics import Balance, free_entries
from twin_core.network.model import Network
from twin_core.network.storage import store, to_enthalpy_K
from twin_core.simulate.derivatives import march_sensitivities
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.large import MANY, march_sensitivities_of_many
from twin_core.simulate.modes import NO_TURNING, Modes, Turning
from twin_core.simulate.one_step import take_steps
from twin_core.simulate.relays import N_KICK, NO_RELAYS, Relays
from twin_core.simulate.rollout import Rollout
from twin_core.simulate.splitting import (
    Split,
    anchors,
    less_modes,
    modes_of,
    pieces,
    symmetric,
    turning,
)
from twin_core.simulate.stages import balance_along

MOST_VALUES, LEAST_STEPS = 16_000_000, 64
"""So many derivatives are made at once, if that is more than so many steps: 128 MB."""

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
    about_K, turns = None, NO_TURNING
    most = max(LEAST_STEPS, MOST_VALUES // max(observed.size * state.shape[1], 1))
    for first, last, anchor in pieces(anchors(trajectory.stages_K[:, 0]), most):
        low = int(np.searchsorted(forcing.sample_step, first, side="left" if first == 0 else "right"))
        high = int(np.searchsorted(forcing.sample_step, last, side="right"))
        stages_K, step_s = trajectory.stages_K[first:last], forcing.step_s[first:last]
        switched = _Switched.along(Split.at(network, values, forcing, first, last, anchor), stages_K)
        modes = switched.split.modes
        if anchor is not about_K:
            about_K = anchor
            turns = turning(network, values, forcing, about_K, switched.split.parts).per(own)
        balance = balance_along(
            network,
            values,
            forcing,
            stages_K,
            first,
            last,
            derivatives=True,
            extra_W=switched.heat_W,
            only=switched.split.steady,
        )
        entries = _joined((balance.entry_free, balance.entry_node, balance.entry_series), switched.entries())
        if network.capacities:
            stored = _stored_entries(network, values, stages_K, step_s, begin_K)
            entries = _joined(entries, stored)
        samples = forcing.sample_step[low:high] - first
        stages = to_enthalpy_K(network, values, stages_K)
        split = _Split(
            modes,
            switched.split.slope_W_per_K,
            turns,
            stages,
            switched.split.relays,
            switched.kicks,
            *switched.columns(),
        )
        begin_slope = store(network, values, begin_K[None]).slope
        block, state = _march(balance, step_s, split, entries, state, begin_slope, samples, observed)
        yield slice(low, high), block
        begin_K = stages_K[-1, 1] if stages_K.size else begin_K


@dataclass(frozen=True)
class _Split:
    """A as it was in the rollout: its modes, C A, and how columns change A."""

    modes: Modes
    slope_W_per_K: FloatArray
    turns: Turning
    stages: FloatArray
    relays: Relays
    kicks: FloatArray
    relay_column: IntArray
    relay_slope: FloatArray


@dataclass(frozen=True)
class _Switched:
    """What the relays of a stretch did, ``kicks`` (n_steps, n_relays, N_KICK)."""

    split: Split
    kicks: FloatArray

    @classmethod
    def along(cls, split: Split, stages_K: FloatArray) -> "_Switched":
        """Take the steps of a trajectory once more where there are relays."""
        if not split.parts.relays:
            return cls(split, np.zeros((stages_K.shape[0], 0, N_KICK)))
        return cls(split, take_steps(split, stages_K)[1])

    @property
    def heat_W(self) -> FloatArray | None:
        """Return the heat at both ends of the steps, (n_steps, 2, n_nodes); None without relays."""
        if not self.split.parts.relays:
            return None
        heat = np.zeros((self.kicks.shape[0], 2, self.split.about_K.size))
        for r, (_, relay) in enumerate(self.split.parts.relays):
            heat[:, :, relay.node] += relay.power_W * self.kicks[:, r, :2]
        return heat

    def _free(self, index: int) -> tuple[int, float]:
        """Return the position of a parameter, or that it is tied to, among the free ones (-1 where held), and its slope."""
        parameters = self.split.network.parameters
        shared, size = parameters.ties.get(index, (index, 1.0))
        found = np.flatnonzero(parameters.free_index == shared)
        slope = parameters.slope(shared, float(self.split.values[shared]))
        return (int(found[0]), size * slope) if found.size else (-1, 0.0)

    @cached_property
    def _powers(self) -> list[tuple[int, float]]:
        """The free parameters of the relays' powers."""
        return [self._free(int(self.split.network.term_indices[term][0])) for term, _ in self.split.parts.relays]

    def entries(self) -> "Entries":
        """Return the derivatives with the powers."""
        rows = [
            (column, relay.node, slope * self.kicks[:, r, :2].ravel() / self.split.own_J_per_K[relay.node])
            for r, ((column, slope), (_, relay)) in enumerate(zip(self._powers, self.split.parts.relays, strict=True))
            if column >= 0
        ]
        return (
            np.array([column for column, _, _ in rows], dtype=np.int64),
            np.array([node for _, node, _ in rows], dtype=np.int64),
            np.array([series for _, _, series in rows]).reshape(len(rows), 2 * self.kicks.shape[0]),
        )

    def columns(self) -> tuple[IntArray, FloatArray]:
        """Return which columns thresholds and rates depend on, and how, (4, n_relays) each (``march_sensitivities``)."""
        split, network = self.split, self.split.network
        nodes, rate = split.relays.node, split.relays.rate
        own = split.own_J_per_K[nodes]
        rows = [
            [self._free(int(network.term_indices[term][item])) for term, _ in split.parts.relays] for item in (1, 2)
        ]
        rows += [self._powers, [self._free(int(network.capacity_index[node])) for node in nodes]]
        by = [split.thresholds("on_K")[1], split.thresholds("off_K")[1], 1.0 / own, -rate / own]
        column = np.array([[c for c, _ in row] for row in rows], dtype=np.int64).reshape(4, nodes.size)
        return column, np.array([[s for _, s in row] for row in rows]).reshape(4, nodes.size) * np.array(by)


def _joined(first: "Entries", second: "Entries") -> "Entries":
    """Return two sets of entries as one."""
    column, node, series = (np.concatenate(pair) for pair in zip(first, second, strict=True))
    return column, node, series


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
    split = _Split(
        modes_of(slope, balance.own_J_per_K),
        slope,
        NO_TURNING,
        np.zeros((forcing.n_steps, 2, n_nodes)),
        NO_RELAYS,
        np.zeros((forcing.n_steps, 0, N_KICK)),
        np.zeros((4, 0), dtype=np.int64),
        np.zeros((4, 0)),
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
    along = (
        step_s,
        split.modes,
        *less_modes(balance.jacobian, split.slope_W_per_K, balance.own_J_per_K),
        split.stages,
        (balance.heat_W / balance.own_J_per_K).reshape(shape),
    )
    switched = (split.relays, split.kicks, split.relay_column, split.relay_slope)
    rest = (column, node, series.reshape(column.size, step_s.size, 2), state, sample_step, observed)
    if state.shape[0] >= MANY and split.relays.node.size == 0:
        block, end = march_sensitivities_of_many(*along, split.turns, *rest)
    else:
        block, end = march_sensitivities(*along, *switched, split.turns, *rest)
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
