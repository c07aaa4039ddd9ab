"""Boundary temperatures as the terms of a network see them: declared, unknown constants, or changed by effects."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.model import Network
from twin_core.network.terms import Along, BoundaryTerm


@dataclass(frozen=True)
class Surroundings:
    """The points of an evaluation with the boundaries that the terms see, and what these depend on.

    Attributes
    ----------
    along
        Its ``boundaries_K`` are what effects make of those that are declared, which stay in ``given_K``.
    by_value
        Boundary -> (parameter, d temperature / d value (n_points,)).
    by_state
        Boundary -> (node, d temperature / d temperature of the node (n_points,)).
    """

    along: Along
    by_value: dict[int, list[tuple[int, FloatArray]]]
    by_state: dict[int, list[tuple[int, FloatArray]]]


def surround(network: Network, values: FloatArray, along: Along) -> Surroundings:
    """Return the points of an evaluation with every boundary as the terms see it.

    Parameters
    ----------
    network
        The network with its boundary terms.
    values : (n_parameters,)
        Physical parameter values.
    along
        The points; unknown constants are filled (``fill_boundaries``). Applied twice it changes nothing.
    """
    by_value: dict[int, list[tuple[int, FloatArray]]] = {}
    by_state: dict[int, list[tuple[int, FloatArray]]] = {}
    for boundary, index in enumerate(network.boundary_index):
        if index >= 0:
            by_value[boundary] = [(int(index), np.ones(along.time_s.size))]
    for boundaries_K, term, index in _changes(network, values, along):
        found = term.evaluate(boundaries_K[:, term.boundary], along, values[index])
        boundaries_K[:, term.boundary] = found.temperature_K
        for chain, own in (
            (by_value, [(int(index[item]), series) for item, series in found.d_values]),
            (by_state, found.d_states),
        ):
            passed = [(item, found.d_given * series) for item, series in chain.get(term.boundary, [])]
            chain[term.boundary] = passed + own
        along = replace(along, boundaries_K=boundaries_K, given_K=along.declared_K)
    return Surroundings(along, by_value, by_state)


def boundary_heats_W(network: Network, values: FloatArray, along: Along) -> list[tuple[BoundaryTerm, FloatArray]]:
    """Return what each change of a boundary brings into the nodes, (n_points, n_nodes), in the order in which they act.

    Each is the heat of all terms with it less that without it, those before it in force: they add up to what all bring.
    """
    here, found = replace(along, boundaries_K=along.declared_K, given_K=along.declared_K), []
    before = None
    for boundaries_K, term, index in _changes(network, values, along):
        before = _heat_W(network, values, here) if before is None else before
        boundaries_K[:, term.boundary] = term.evaluate(
            boundaries_K[:, term.boundary], along, values[index]
        ).temperature_K
        after = _heat_W(network, values, replace(here, boundaries_K=boundaries_K))
        found.append((term, after - before))
        before = after
    return found


def _changes(network: Network, values: FloatArray, along: Along) -> Iterator[tuple[FloatArray, BoundaryTerm, IntArray]]:
    """Yield the boundaries that the next term changes in place, (n_points, n_boundaries), the term and its parameters."""
    boundaries_K = along.declared_K.copy() if network.boundary_terms else along.declared_K
    for term in network.boundary_terms:
        yield boundaries_K, term, network.term_index(term)


def _heat_W(network: Network, values: FloatArray, along: Along) -> FloatArray:
    """Return the heat of all terms into the nodes, (n_points, n_nodes)."""
    heat = np.zeros(along.temperatures_K.shape)
    for term, index in zip(network.terms, network.term_indices, strict=True):
        part = term.evaluate(along, values[index])
        heat[:, list(part.nodes)] += part.heat_W
    return heat
