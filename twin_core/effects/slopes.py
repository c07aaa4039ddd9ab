"""The derivatives that an effect states, against central differences of its heat, capacity, reading or boundary."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from twin_core._typing import FloatArray
from twin_core.network.model import Addition, Network
from twin_core.network.terms import Along, BoundaryTerm, CapacityTerm, ReadingTerm, Term

STEP_K = 1e-2
LEAST_SMOOTH = 0.8
"""Share of points at which a slope must be defined: a threshold is a kink, and a kink within the step tells nothing."""

Errors = Iterator[tuple[str, float]]
"""What was compared, and the largest difference as a share of the largest slope."""


def slope_errors(network: Network, addition: Addition, along: Along) -> Errors:
    """Yield how far the derivatives of what an effect adds are off.

    Parameters
    ----------
    network
        A network with the effect, at values that are not null.
    addition
        What the effect adds to it.
    along
        Points in pairs, boundaries filled: a heat may be shared out over both points of a step.
    """
    for term in addition.terms:
        yield from _of_heat(network, term, along)
    for capacity in addition.capacities:
        yield from _of_capacity(network, capacity, along)
    for reading in addition.readings:
        yield from _of_reading(network, reading, along)
    for boundary in addition.boundaries:
        yield from _of_boundary(network, boundary, along)


def _of_heat(network: Network, term: Term, along: Along) -> Errors:
    """Heats are summed over both points of a step, one of which is moved."""
    n_points, n = along.temperatures_K.shape
    values = network.parameters.values[network.term_index(term)]
    part = term.evaluate(along, values)

    def heat(along: Along, values: FloatArray) -> FloatArray:
        part = term.evaluate(along, values)
        dense = np.zeros((n_points, n))
        dense[:, list(part.nodes)] += part.heat_W
        return dense[0::2] + dense[1::2]

    jacobian = np.zeros((n_points, n, n))
    nodes = np.array(part.nodes)
    jacobian[:, nodes[:, None], nodes] += part.d_temperature
    for node, end in ((node, end) for node in range(n) for end in (0, 1)):

        def by_temperature(shift_K: float, node: int = node, end: int = end) -> FloatArray:
            moved = along.temperatures_K.copy()
            moved[end::2, node] += shift_K
            return heat(replace(along, temperatures_K=moved), values)

        yield f"d heat / d T of {network.nodes[node]}", _error(jacobian[end::2, :, node], by_temperature, 0.0, STEP_K)
    for column, name in enumerate(network.layout.boundaries):
        found = np.zeros((n_points, n))
        for entry in part.d_boundaries:
            if entry.item == column:
                found[:, entry.node] += entry.series

        def by_boundary(shift_K: float, column: int = column) -> FloatArray:
            moved = along.boundaries_K.copy()
            moved[:, column] += shift_K
            return heat(replace(along, boundaries_K=moved, given_K=along.declared_K), values)

        yield f"d heat / d T of {name}", _error(found[0::2] + found[1::2], by_boundary, 0.0, STEP_K)
    stated = np.zeros((values.size, n_points, n))
    for entry in part.d_values:
        stated[entry.item, :, entry.node] += entry.series
    yield from _by_values(network, term, stated[:, 0::2] + stated[:, 1::2], lambda x: heat(along, x))


def _of_capacity(network: Network, term: CapacityTerm, along: Along) -> Errors:
    temperature_K = along.temperatures_K[:, term.node]
    values = network.parameters.values[network.term_index(term)]
    part = term.evaluate(temperature_K, values)

    def capacity(shift_K: float) -> FloatArray:
        return term.evaluate(temperature_K + shift_K, values).extra_J_per_K

    def stored(shift_K: float) -> FloatArray:
        return term.evaluate(temperature_K + shift_K, values).stored_J

    yield "d capacity / d T", _error(part.d_temperature, capacity, 0.0, STEP_K)
    yield "d stored heat / d T", _error(part.extra_J_per_K, stored, 0.0, STEP_K)
    for entries, read in ((part.d_values, "extra_J_per_K"), (part.d_stored, "stored_J")):
        stated = np.zeros((values.size, temperature_K.size))
        for entry in entries:
            stated[entry.item] += entry.series

        def at(x: FloatArray, read: str = read) -> FloatArray:
            return np.asarray(getattr(term.evaluate(temperature_K, x), read))

        yield from _by_values(network, term, stated, at)


def _of_reading(network: Network, term: ReadingTerm, along: Along) -> Errors:
    values = network.parameters.values[network.term_index(term)]
    stated = np.zeros((values.size, along.time_s.size))
    for item, series in term.evaluate(along.time_s, values).d_values:
        stated[item] += series
    yield from _by_values(network, term, stated, lambda x: term.evaluate(along.time_s, x).offset_K)


def _of_boundary(network: Network, term: BoundaryTerm, along: Along) -> Errors:
    values = network.parameters.values[network.term_index(term)]
    given_K = along.boundaries_K[:, term.boundary]
    part = term.evaluate(given_K, along, values)
    stated = np.zeros((values.size, along.time_s.size))
    for item, series in part.d_values:
        stated[item] += series

    def by_given(shift_K: float) -> FloatArray:
        return term.evaluate(given_K + shift_K, along, values).temperature_K

    yield "d boundary / d what was there", _error(part.d_given, by_given, 0.0, STEP_K)
    yield from _by_values(network, term, stated, lambda x: term.evaluate(given_K, along, x).temperature_K)
    for node, name in enumerate(network.nodes):
        found = sum((series for state, series in part.d_states if state == node), np.zeros(along.time_s.size))

        def by_state(shift_K: float, node: int = node) -> FloatArray:
            moved = along.temperatures_K.copy()
            moved[:, node] += shift_K
            return term.evaluate(given_K, replace(along, temperatures_K=moved), values).temperature_K

        yield f"d boundary / d T of {name}", _error(found, by_state, 0.0, STEP_K)


def _by_values(
    network: Network,
    term: Term | CapacityTerm | ReadingTerm | BoundaryTerm,
    stated: FloatArray,
    at_values: Callable[[FloatArray], FloatArray],
) -> Errors:
    """Compare derivatives by values (n_values, ...), each in the coordinate in which a solver moves it."""
    index = network.term_index(term)
    values = network.parameters.values[index]
    for item, position in enumerate(index):
        parameter = network.parameters.parameters[position]

        def moved(free: float, item: int = item, transform: object = parameter.transform) -> FloatArray:
            x = values.copy()
            x[item] = transform.to_value(free)  # type: ignore[attr-defined]
            return at_values(x)

        slope = parameter.transform.slope(parameter.free)
        step = 1e-3 * max(1.0, 0.1 * abs(parameter.free))
        yield f"the derivative by {parameter.name}", _error(slope * stated[item], moved, parameter.free, step)


def _error(stated: FloatArray, function: Callable[[float], FloatArray], at: float, step: float) -> float:
    """Return the largest difference from a central difference, as a share of the largest slope, but at kinks; inf if all are."""
    coarse, fine = _central_difference(function, at, step), _central_difference(function, at, step / 3.0)
    scale = float(max(np.abs(fine).max(), np.abs(stated).max()))
    rounding = 1e-13 * float(np.abs(function(at)).max()) / step
    if scale <= rounding:
        return 0.0
    smooth = np.abs(coarse - fine) <= 1e-6 * scale + rounding
    if smooth.mean() < LEAST_SMOOTH:
        return float("inf")
    wrong = np.abs(stated - fine)[smooth] - rounding
    return max(0.0, float(wrong.max()) / scale)


def _central_difference(function: Callable[[float], FloatArray], at: float, step: float) -> FloatArray:
    """Return d function / dx by a central difference of fourth order."""
    near = function(at + step) - function(at - step)
    far = function(at + 2.0 * step) - function(at - 2.0 * step)
    return (8.0 * near - far) / (12.0 * step)
