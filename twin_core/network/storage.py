"""What nodes store: capacity and enthalpy as functions of temperature, and temperature as a function of enthalpy."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray
from twin_core.network.model import Network
from twin_core.network.terms import CapacityTerm, Entry

TOLERANCE_K = 1e-11
ROUNDING = 8.0 * np.finfo(np.float64).eps
"""Share of u and T to which u is computed: where a node stores little, that is more than the tolerance in T."""

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

    u grows with T, so there is one, or the limit beyond which it lies: Newton's method from ``near_K``, within a bracket that
    is halved where the capacity bends too sharply for it, for the points that are not found yet.
    """
    if not network.capacities:
        return enthalpy_K
    found_K = np.clip(enthalpy_K, *limit_K)
    for node in {term.node for term in network.capacities}:
        terms = [(term, values[network.term_index(term)]) for term in network.capacities if term.node == node]
        near = np.clip(near_K[..., node], *limit_K).ravel()
        own = float(values[network.capacity_index[node]])
        temperature_K = _inverted(terms, own, enthalpy_K[..., node].ravel(), near, limit_K)
        found_K[..., node] = temperature_K.reshape(found_K.shape[:-1])
    return found_K


def _inverted(
    terms: Sequence[tuple[CapacityTerm, FloatArray]],
    own_J_per_K: float,
    enthalpy_K: FloatArray,
    near_K: FloatArray,
    limit_K: tuple[float, float],
) -> FloatArray:
    """Return the temperatures (n_points,) at which one node with these terms and their values has enthalpies (n_points,)."""

    def at(temperature_K: FloatArray) -> tuple[FloatArray, FloatArray]:
        enthalpy, capacity = temperature_K, np.ones_like(temperature_K)
        for term, value in terms:
            part = term.evaluate(temperature_K, value)
            enthalpy = enthalpy + part.stored_J / own_J_per_K
            capacity = capacity + part.extra_J_per_K / own_J_per_K
        return enthalpy, capacity

    least, most = at(np.array(limit_K))[0]
    wanted = np.clip(enthalpy_K, least, most)
    now = np.where(wanted == least, limit_K[0], np.where(wanted == most, limit_K[1], near_K))
    low, high = np.full_like(wanted, limit_K[0]), np.full_like(wanted, limit_K[1])
    miss_before = np.full_like(wanted, np.inf)
    found, points = now.copy(), np.arange(now.size)
    for _ in range(N_ITERATIONS):
        enthalpy, capacity = at(now)
        miss = enthalpy - wanted
        size = np.abs(miss)
        low, high = np.where(miss < 0.0, now, low), np.where(miss > 0.0, now, high)
        newton = now - miss / capacity
        slow = ((size > 0.5 * miss_before) | (newton < low) | (newton > high)) & (size > TOLERANCE_K)
        following = np.where(slow, 0.5 * (low + high), newton)
        found[points] = following
        goes_on = (np.abs(following - now) >= TOLERANCE_K) & (size >= ROUNDING * (np.abs(now) + np.abs(wanted)))
        if not goes_on.any():
            break
        now, wanted, low, high = (a[goes_on] for a in (following, wanted, low, high))
        points, miss_before = points[goes_on], size[goes_on]
    return np.clip(found, *limit_K)
