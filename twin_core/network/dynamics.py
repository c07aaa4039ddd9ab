"""The heat balance C dT/dt = sum of heats, evaluated at many points at once, with its exact derivatives."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.jacobian import Jacobian, JacobianSum
from twin_core.network.model import Network
from twin_core.network.terms import Along, Entry


@dataclass(frozen=True)
class Balance:
    """Rates and derivatives at n_points.

    Attributes
    ----------
    rate_K_per_s : (n_points, n_nodes)
    jacobian
        d rate / d temperature; ``jacobian_per_s`` holds it as (n_points, n_nodes, n_nodes).
    heat_W : (n_points, n_nodes)
        Net heat into each node.
    capacity_J_per_K : (n_points, n_nodes)
    entry_free, entry_node : (n_entries,)
        Which free parameter and which node a derivative series belongs to.
    entry_series : (n_entries, n_points)
        d rate / d free parameter, in the solver's coordinate.
    """

    rate_K_per_s: FloatArray
    jacobian: Jacobian
    heat_W: FloatArray
    capacity_J_per_K: FloatArray
    entry_free: IntArray
    entry_node: IntArray
    entry_series: FloatArray

    @cached_property
    def jacobian_per_s(self) -> FloatArray:
        """The Jacobian as dense matrices."""
        return self.jacobian.dense()


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
) -> Balance:
    """Evaluate the heat balance of a network.

    Parameters
    ----------
    network
        The network with its terms.
    values : (n_parameters,)
        Physical parameter values.
    along
        The points; its boundaries must be filled.
    derivatives
        Whether to return the parameter derivatives too.
    extra_W : (n_points, n_nodes)
        Heat beyond the terms.

    Returns
    -------
    Balance
        C_i dT_i/dt = sum of the terms' heats into node i.
    """
    n_points, n_nodes = along.temperatures_K.shape
    along = replace(along, derivatives=derivatives)
    heat = np.zeros((n_points, n_nodes)) if extra_W is None else extra_W.astype(np.float64)
    jacobian = JacobianSum(n_nodes)
    everywhere = tuple(range(n_nodes))
    entries: list[Entry] = []
    for term, index in zip(network.terms, network.term_indices, strict=True):
        part = term.evaluate(along, values[index])
        jacobian.add(part)
        if len(part.nodes) == 1:  # slices, which cost a fraction of index arrays
            heat[:, part.nodes[0]] += part.heat_W[:, 0]
        elif part.nodes == everywhere:
            heat += part.heat_W
        else:
            heat[:, np.asarray(part.nodes)] += part.heat_W
        if derivatives:
            entries += [Entry(int(index[e.item]), e.node, e.series) for e in part.d_values]
            entries += [
                Entry(int(network.boundary_index[e.item]), e.node, e.series)
                for e in part.d_boundaries
                if network.boundary_index[e.item] >= 0
            ]
    capacity, slope, capacity_entries = _capacities(network, values, along)
    rate = heat / capacity
    moves = [node for node in range(n_nodes) if slope[:, node].any()] if network.capacities else []
    correction = -rate * slope / capacity if moves else slope
    slopes = jacobian.over(capacity, moves, correction)
    if not derivatives:
        nothing = np.zeros(0, dtype=np.int64)
        return Balance(rate, slopes, heat, capacity, nothing, nothing, np.zeros((0, n_points)))
    rows = [Entry(e.item, e.node, e.series / capacity[:, e.node]) for e in entries]
    rows += [Entry(e.item, e.node, -e.series * rate[:, e.node] / capacity[:, e.node]) for e in capacity_entries]
    return _free_entries(network, values, rate, slopes, heat, capacity, rows)


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


def _capacities(network: Network, values: FloatArray, along: Along) -> tuple[FloatArray, FloatArray, list[Entry]]:
    """Return the capacity of each node (n_points, n_nodes), its slope with temperature, and derivative entries of C."""
    n_points, n_nodes = along.temperatures_K.shape
    capacity = np.broadcast_to(values[network.capacity_index], (n_points, n_nodes)).copy()
    slope = np.zeros((n_points, n_nodes))
    one = np.ones(n_points)
    entries = [Entry(int(index), node, one) for node, index in enumerate(network.capacity_index)]
    for term in network.capacities:
        index = network.term_index(term)
        part = term.evaluate(along, values[index])
        capacity[:, part.node] += part.extra_J_per_K
        slope[:, part.node] += part.d_temperature
        entries += [Entry(int(index[e.item]), e.node, e.series) for e in part.d_values]
    return capacity, slope, entries


def _free_entries(
    network: Network,
    values: FloatArray,
    rate: FloatArray,
    jacobian: Jacobian,
    heat: FloatArray,
    capacity: FloatArray,
    rows: list[Entry],
) -> Balance:
    """Keep the entries of free parameters, in the solver's coordinate."""
    parameters = network.parameters
    position = {int(index): k for k, index in enumerate(parameters.free_index)}
    at = parameters.at_values(values)
    slopes = {int(i): at.parameters[i].transform.slope(at.parameters[i].free) for i in parameters.free_index}
    kept = [row for row in rows if row.item in position]
    series = np.array([slopes[row.item] * row.series for row in kept]).reshape(len(kept), rate.shape[0])
    free = np.array([position[row.item] for row in kept], dtype=np.int64)
    node = np.array([row.node for row in kept], dtype=np.int64)
    return Balance(rate, jacobian, heat, capacity, free, node, series)
