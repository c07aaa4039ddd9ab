"""What nodes store: capacity and enthalpy as functions of temperature, and temperature as a function of enthalpy."""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray
from twin_core.network.model import Network
from twin_core.network.terms import Entry

TOLERANCE_K = 1e-11
N_ITERATIONS = 100


@dataclass(frozen=True)
class Storage:
    """Capacity and enthalpy at n_points, for C_0 the node's own capacity.

    Attributes
    ----------
    capacity_J_per_K, bend_per_K, slope : (n_points, n_nodes)
        C, d ln C / d T and d T / d u = C_0 / C.
    enthalpy_K : (n_points, n_nodes)
        u = T + (integral of C - C_0 over T) / C_0.
    moves
        Nodes with terms of capacity; the others' u is their T.
    entries
        d u / d parameter at the same temperature: of the parameters of those terms.
    """

    capacity_J_per_K: FloatArray
    bend_per_K: FloatArray
    enthalpy_K: FloatArray
    moves: tuple[int, ...]
    entries: list[Entry]
    slope: FloatArray


def store(network: Network, values: FloatArray, temperatures_K: FloatArray) -> Storage:
    """Return what the nodes store at temperatures (n_points, n_nodes)."""
    own = values[network.capacity_index]
    capacity = np.broadcast_to(own, temperatures_K.shape)
    if not network.capacities:
        return Storage(capacity, np.zeros_like(capacity), temperatures_K, (), [], np.ones_like(capacity))
    capacity, enthalpy = capacity.copy(), temperatures_K.copy()
    slope = np.zeros_like(capacity)
    entries: list[Entry] = []
    for term in network.capacities:
        index, node = network.term_index(term), term.node
        part = term.evaluate(temperatures_K[:, node], values[index])
        capacity[:, node] += part.extra_J_per_K
        slope[:, node] += part.d_temperature
        enthalpy[:, node] += part.stored_J / own[node]
        entries += [Entry(int(index[e.item]), node, e.series / own[node]) for e in part.d_stored]
        entries.append(Entry(int(network.capacity_index[node]), node, -part.stored_J / own[node] ** 2))
    moves = tuple(sorted({term.node for term in network.capacities}))
    return Storage(capacity, slope / capacity, enthalpy, moves, entries, own / capacity)


def to_enthalpy_K(network: Network, values: FloatArray, temperatures_K: FloatArray) -> FloatArray:
    """Return u of the nodes at temperatures (..., n_nodes)."""
    if not network.capacities:
        return temperatures_K
    flat = temperatures_K.reshape(-1, temperatures_K.shape[-1])
    return store(network, values, flat).enthalpy_K.reshape(temperatures_K.shape)


def to_temperatures_K(
    network: Network, values: FloatArray, enthalpy_K: FloatArray, near_K: FloatArray, limit_K: tuple[float, float]
) -> FloatArray:
    """Return the temperatures within limits at which u is ``enthalpy_K``, (..., n_nodes).

    u grows with T, so there is one: Newton's method from ``near_K``, within a bracket that is halved where the capacity
    bends too sharply for it.
    """
    if not network.capacities:
        return enthalpy_K
    own = values[network.capacity_index]
    wanted = enthalpy_K.reshape(-1, own.size)
    low, high = np.full_like(wanted, limit_K[0]), np.full_like(wanted, limit_K[1])
    now, miss_before = np.clip(near_K, *limit_K).reshape(-1, own.size), np.full_like(wanted, np.inf)
    for _ in range(N_ITERATIONS):
        at = store(network, values, now)
        miss = at.enthalpy_K - wanted
        low, high = np.where(miss < 0.0, now, low), np.where(miss > 0.0, now, high)
        newton = now - miss * at.slope
        slow = (np.abs(miss) > 0.5 * miss_before) | (newton < low) | (newton > high)
        following = np.where(slow & (np.abs(miss) > TOLERANCE_K), 0.5 * (low + high), newton)
        change = float(np.abs(following - now).max(initial=0.0))
        now, miss_before = following, np.abs(miss)
        if change < TOLERANCE_K:
            break
    return np.clip(now, *limit_K).reshape(enthalpy_K.shape)
