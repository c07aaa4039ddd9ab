"""The heat balance C dT/dt = sum of heats, evaluated at many points at once, with its exact derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.jacobian import Jacobian, JacobianSum
from twin_core.network.model import Network
from twin_core.network.storage import store
from twin_core.network.surroundings import surround
from twin_core.network.terms import Along, Entry


@dataclass(frozen=True)
class Balance:
    """Heats and derivatives at n_points.

    A node of capacity C(T) holds the enthalpy C_0 u, u = T + (integral of C - C_0) / C_0 with C_0 its own capacity, and
    C_0 du/dt = heat holds whatever C(T) is. That is the form in which steps are taken (``jacobian`` and ``entry_series``):
    it keeps the energy balance over a step of any length. Without terms of capacity u is T.

    Attributes
    ----------
    heat_W : (n_points, n_nodes)
        Net heat into each node.
    flow
        d heat / d temperature over the own capacity.
    own_J_per_K : (n_nodes,)
        C_0.
    capacity_J_per_K : (n_points, n_nodes)
        C(T).
    bend_per_K, slope : (n_points, n_nodes)
        d ln C / d T and d T / d u = C_0 / C.
    moves
        Nodes whose capacity depends on their temperature.
    entry_free, entry_node : (n_entries,)
        Which free parameter and which node a derivative series belongs to.
    entry_series : (n_entries, n_points)
        d (heat / C_0) / d free parameter, in the solver's coordinate, at the same temperatures.
    """

    heat_W: FloatArray
    flow: Jacobian
    own_J_per_K: FloatArray
    capacity_J_per_K: FloatArray
    bend_per_K: FloatArray
    slope: FloatArray
    moves: tuple[int, ...]
    entry_free: IntArray
    entry_node: IntArray
    entry_series: FloatArray

    @cached_property
    def rate_K_per_s(self) -> FloatArray:
        """d T / d t, (n_points, n_nodes)."""
        return self.heat_W / self.capacity_J_per_K

    @cached_property
    def jacobian_per_s(self) -> FloatArray:
        """d (d T / d t) / d T as dense matrices, (n_points, n_nodes, n_nodes)."""
        dense = self.flow.dense()
        if self.moves:
            dense *= self.slope[:, :, None]
            nodes = np.arange(self.own_J_per_K.size)
            dense[:, nodes, nodes] -= self.rate_K_per_s * self.bend_per_K
        return dense

    @cached_property
    def jacobian(self) -> Jacobian:
        """d (d u / d t) / d u."""
        return self.flow.with_columns_scaled(self.moves, self.slope) if self.moves else self.flow


def fill_boundaries(network: Network, values: FloatArray, boundaries_K: FloatArray) -> FloatArray:
    """Return the boundary temperatures, (n_points, n_boundaries), with unknown constants at their present value."""
    filled = boundaries_K.copy()
    for column, index in enumerate(network.boundary_index):
        if index >= 0:
            filled[:, column] = values[index]
    return filled


def evaluate_balance(
    network: Network,
    values: FloatArray,
    along: Along,
    *,
    derivatives: bool = False,
    extra_W: FloatArray | None = None,
    only: Sequence[int] | None = None,
) -> Balance:
    """Evaluate the heat balance of a network.

    Parameters
    ----------
    network
        The network with its terms.
    values : (n_parameters,)
        Physical parameter values.
    along
        The points; its boundaries must be filled. Effects on boundaries act here, for all terms alike.
    derivatives
        Whether to return the parameter derivatives too.
    extra_W : (n_points, n_nodes)
        Heat beyond the terms.
    only
        Positions of the terms that are evaluated; all by default.

    Returns
    -------
    Balance
        C_i dT_i/dt = sum of the terms' heats into node i.
    """
    n_points, n_nodes = along.temperatures_K.shape
    around = surround(network, values, replace(along, derivatives=derivatives))
    heat = np.zeros((n_points, n_nodes)) if extra_W is None else extra_W.astype(np.float64)
    jacobian = JacobianSum(n_nodes)
    everywhere = tuple(range(n_nodes))
    entries: list[Entry] = []
    for position in range(len(network.terms)) if only is None else only:
        index = network.term_indices[position]
        part = network.terms[position].evaluate(around.along, values[index])
        jacobian.add(part, along.temperatures_K)
        for e in part.d_boundaries:
            for state, series in around.by_state.get(e.item, ()):
                jacobian.add_entry(e.node, state, e.series * series)
        if len(part.nodes) == 1:  # slices, which cost a fraction of index arrays
            heat[:, part.nodes[0]] += part.heat_W[:, 0]
        elif part.nodes == everywhere:
            heat += part.heat_W
        else:
            heat[:, np.asarray(part.nodes)] += part.heat_W
        if derivatives:
            entries += [Entry(int(index[e.item]), e.node, e.series) for e in part.d_values]
            entries += [
                Entry(item, e.node, e.series * series)
                for e in part.d_boundaries
                for item, series in around.by_value.get(e.item, ())
            ]
    own = values[network.capacity_index]
    storage = store(network, values, along.temperatures_K)
    flow = jacobian.over(own, n_points)
    rows = [Entry(e.item, e.node, e.series / own[e.node]) for e in entries]
    if derivatives:
        rows += [Entry(int(i), n, -heat[:, n] / own[n] ** 2) for n, i in enumerate(network.capacity_index)]
    return Balance(
        heat,
        flow,
        own,
        storage.capacity_J_per_K,
        storage.bend_per_K,
        storage.slope,
        storage.moves,
        *free_entries(network, values, rows, n_points),
    )


def reading_offsets_K(network: Network, values: FloatArray, clock_s: FloatArray) -> FloatArray:
    """Return what the sensors read beyond the temperature of their states, (n_times, n_sensors).

    Parameters
    ----------
    network
        The network with its sensor faults.
    values : (n_parameters,)
        Physical parameter values.
    clock_s : (n_times,)
        Sample times, as of ``Record.clock_s``.
    """
    offset = np.zeros((clock_s.size, network.sensor_node.size))
    for term in network.readings:
        part = term.evaluate(clock_s, values[network.term_index(term)])
        offset[:, part.sensor] += part.offset_K
    return offset


def free_entries(
    network: Network, values: FloatArray, rows: list[Entry], n_points: int
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the entries of free parameters, in the solver's coordinate: which parameter, which node, the series."""
    if not rows:
        nothing = np.zeros(0, dtype=np.int64)
        return nothing, nothing, np.zeros((0, n_points))
    parameters = network.parameters
    position = {int(index): k for k, index in enumerate(parameters.free_index)}
    if parameters.ties:  # the chain rule: what moves with a shared unknown counts as moved by it
        told = [(*parameters.ties.get(row.item, (row.item, 1.0)), row) for row in rows]
        rows = [Entry(item, row.node, size * row.series) for item, size, row in told]
    kept = [row for row in rows if row.item in position]
    slopes = {item: parameters.slope(item, float(values[item])) for item in {r.item for r in kept}}
    series = np.array([slopes[row.item] * row.series for row in kept]).reshape(len(kept), n_points)
    free = np.array([position[row.item] for row in kept], dtype=np.int64)
    node = np.array([row.node for row in kept], dtype=np.int64)
    return free, node, series
