"""The heat balance split for the integrator: what is linearised once, what is known at any temperature, and the rest.

Most terms are linear in temperature, or in its fourth power, with factors that no step changes: one evaluation at any
temperature tells them for all. Their Jacobian about round temperatures is the A of the exponential integrator. Terms of
another kind (convection, relays, ramps of a conductance) are evaluated along the trajectory, again and again.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4, ZERO_CELSIUS_K
from twin_core.network.dynamics import Balance, evaluate_balance, fill_boundaries
from twin_core.network.jacobian import Jacobian
from twin_core.network.model import Network
from twin_core.network.storage import store, to_enthalpy_K
from twin_core.network.surroundings import surround
from twin_core.network.terms import Along, ChannelLoad, Conductors, NodeRadiation, Relay, TableLoad
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.kernels import Remainder
from twin_core.simulate.modes import NO_TURNING, Modes, Turning
from twin_core.simulate.relays import NO_RELAYS, Relays

STRETCH, LONGEST_STRETCH, STRETCH_STATES = 1024, 8192, 65_536
"""Steps that are taken together, and after which A is renewed where temperatures have moved. The first stretch may come from
far away; those after it are longer for few nodes, where a call costs more than what it computes."""

ROUND_K = 10.0
"""A is linearised about temperatures rounded to this in degrees Celsius: a constant of the scheme, not of what is fitted."""
FAR_K = 20.0
"""A is renewed where a temperature is further away: T³ is then a quarter off at room temperature."""

DIFFERENCE = 1e-4
"""Relative step of a parameter; couplings are linear in theirs, so that a central difference is good to rounding."""


def stretches(n_steps: int, n_nodes: int) -> Iterator[tuple[int, int]]:
    """Yield (first step, last step) of each stretch of steps of a network."""
    longest = min(max(STRETCH_STATES // n_nodes, STRETCH), LONGEST_STRETCH)
    first, last = 0, min(STRETCH, n_steps)
    while first < n_steps:
        yield first, last
        first, last = last, min(last + longest, n_steps)


def anchors(begins_K: FloatArray) -> Iterator[tuple[int, int, FloatArray]]:
    """Yield (first step, last step, temperatures about which A is linearised) of each stretch of (n_steps, n_nodes)."""
    about = None
    for first, last in stretches(*begins_K.shape):
        about = anchor_K(begins_K[first], about)
        yield first, last, about


def pieces(stretches: Iterable[tuple[int, int, FloatArray]], most: int) -> Iterator[tuple[int, int, FloatArray]]:
    """Yield the same stretches in pieces of at most so many steps, each about the temperatures of its stretch."""
    for first, last, about_K in stretches:
        for begin in range(first, last, most):
            yield begin, min(begin + most, last), about_K


def anchor_K(state_K: FloatArray, before_K: FloatArray | None) -> FloatArray:
    """Return the round temperatures about which a stretch that begins at a state is linearised."""
    if before_K is not None and np.abs(state_K - before_K).max() <= FAR_K:
        return before_K
    return np.asarray(np.maximum(ZERO_CELSIUS_K + ROUND_K * np.rint((state_K - ZERO_CELSIUS_K) / ROUND_K), ROUND_K))


@dataclass(frozen=True)
class Couplings:
    """Terms that are linear in T and T⁴ with constant factors.

    Attributes
    ----------
    linear_W_per_K, fourth_W_per_K4 : (n_nodes, n_nodes)
        heat = linear @ T + fourth @ T⁴ + what is given.
    heat_W : (n_points, n_nodes)
        At the temperatures of the evaluation.
    relays
        Positions of terms that a temperature switches, and by what.
    others
        Positions of the remaining terms.
    """

    linear_W_per_K: FloatArray
    fourth_W_per_K4: FloatArray
    heat_W: FloatArray
    relays: tuple[tuple[int, Relay], ...]
    others: tuple[int, ...]

    def slope_W_per_K(self, about_K: FloatArray) -> FloatArray:
        """Return d heat / d T, (n_nodes, n_nodes)."""
        return self.linear_W_per_K + 4.0 * self.fourth_W_per_K4 * about_K**3


def couplings(network: Network, values: FloatArray, along: Along, *, driven: bool = False) -> Couplings:
    """Return the couplings of a network; ``along`` has two points at least, with one temperature per node.

    What reads a boundary that follows a state is none of them: it is evaluated along the trajectory. ``driven`` leaves out
    the terms between nodes, which read nothing but temperatures.
    """
    around = surround(network, values, along)
    n_points, n = along.temperatures_K.shape
    linear, fourth, heat = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n_points, n))
    everywhere = tuple(range(n))
    relays, others = [], []
    for position, (term, index) in enumerate(zip(network.terms, network.term_indices, strict=True)):
        if driven and isinstance(term, Conductors | NodeRadiation):
            continue
        part = term.evaluate(around.along, values[index])
        if part.relay is not None:
            relays.append((position, part.relay))
            continue
        if around.by_state and any(around.by_state.get(e.item) for e in part.d_boundaries):
            others.append(position)
            continue
        if part.fourth_W_per_K4 is not None:
            matrix, slope = fourth, part.fourth_W_per_K4
        elif part.d_temperature.shape[0] == 1:
            matrix, slope = linear, part.d_temperature[0]
        else:
            others.append(position)
            continue
        if part.nodes == everywhere:
            matrix += slope
            heat += part.heat_W
        elif len(part.nodes) == 1:  # slices, which cost a fraction of index arrays
            matrix[part.nodes[0], part.nodes[0]] += slope[0, 0]
            heat[:, part.nodes[0]] += part.heat_W[:, 0]
        else:
            matrix[np.ix_(part.nodes, part.nodes)] += slope
            heat[:, part.nodes] += part.heat_W
    return Couplings(linear, fourth, heat, tuple(relays), tuple(others))


def _standing(
    network: Network, values: FloatArray, forcing: Forcing, first: int, last: int, about_K: FloatArray
) -> Along:
    """Return the ends of steps first..last-1, all at the same temperatures."""
    boundaries = fill_boundaries(network, values, forcing.boundaries_flat_K(first, last))
    points = np.broadcast_to(about_K, (2 * (last - first), about_K.size))
    return replace(forcing.along(points, boundaries, first, last), derivatives=False)


def probe(network: Network, values: FloatArray, forcing: Forcing, about_K: FloatArray) -> Along:
    """Return the ends of the first step at given temperatures: enough to tell the couplings."""
    boundaries = fill_boundaries(network, values, forcing.boundaries_flat_K(0, 1))
    return replace(forcing.along(np.tile(about_K, (2, 1)), boundaries, 0, 1), derivatives=False)


def symmetric(slope_W_per_K: FloatArray, like: FloatArray | None = None) -> FloatArray:
    """Return the symmetric part of a coupling: of each pair the weaker direction, none where they disagree in sign.

    A reading that follows its node one way, say, is left to the corrector, which takes it as a given that changes over
    the step. ``like`` decides where this is a derivative of that.
    """
    sign = slope_W_per_K if like is None else like
    if np.array_equal(sign, sign.T) and (like is None or np.array_equal(slope_W_per_K, slope_W_per_K.T)):
        return slope_W_per_K
    size = np.abs(sign)
    own = size <= size.T
    out = np.where(own, slope_W_per_K, slope_W_per_K.T)
    out = np.where(size == size.T, 0.5 * (slope_W_per_K + slope_W_per_K.T), out)
    return np.where(sign * sign.T > 0.0, out, 0.0) * (1.0 - np.eye(len(out))) + np.diag(np.diag(slope_W_per_K))


def modes_of(slope_W_per_K: FloatArray, capacity_J_per_K: FloatArray) -> Modes:
    """Return the modes of A = slope / C for a symmetric slope; NaN where a search has left what floats can hold."""
    root = np.sqrt(capacity_J_per_K)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        scaled = slope_W_per_K / (root[:, None] * root)
    if not np.isfinite(scaled).all():
        return Modes(*(np.full(shape, np.nan) for shape in (root.shape, scaled.shape, scaled.shape)))
    rate, vectors = np.linalg.eigh(scaled)
    return Modes(rate, np.ascontiguousarray(vectors / root[:, None]), np.ascontiguousarray(vectors.T * root))


@dataclass(frozen=True)
class Split:
    """The balance of a stretch of steps.

    Attributes
    ----------
    network, values, forcing, first, last
        Whose, and which steps.
    about_K : (n_nodes,)
        Where A is linearised.
    parts
        The couplings over the stretch, at ``about_K``.
    """

    network: Network
    values: FloatArray
    forcing: Forcing
    first: int
    last: int
    about_K: FloatArray
    parts: Couplings

    @classmethod
    def at(
        cls, network: Network, values: FloatArray, forcing: Forcing, first: int, last: int, about_K: FloatArray
    ) -> "Split":
        """Evaluate the couplings of steps first..last-1."""
        if network.capacities:
            return cls(
                network,
                values,
                forcing,
                first,
                last,
                about_K,
                couplings(network, values, probe(network, values, forcing, about_K)),
            )
        along = _standing(network, values, forcing, first, last, about_K)
        return cls(network, values, forcing, first, last, about_K, couplings(network, values, along))

    def given_by(self, forcing: Forcing) -> FloatArray | None:
        """Return the rates that no temperature changes under a forcing of other steps, (n_steps, 2, n_nodes).

        None where not every term is a coupling: then these are not all of them.
        """
        along = _standing(self.network, self.values, forcing, 0, forcing.n_steps, self.about_K)
        parts = couplings(self.network, self.values, along, driven=True)
        if parts.others or parts.relays or self.network.capacities:
            return None
        rates = parts.heat_W
        rates -= parts.linear_W_per_K @ self.about_K + parts.fourth_W_per_K4 @ self.about_K**4
        rates /= self.own_J_per_K
        return rates.reshape(forcing.n_steps, 2, -1)

    @cached_property
    def own_J_per_K(self) -> FloatArray:
        """The nodes' own capacities, (n_nodes,)."""
        return self.values[self.network.capacity_index]

    @cached_property
    def slope_W_per_K(self) -> FloatArray:
        """C A, symmetric."""
        return symmetric(self.parts.slope_W_per_K(self.about_K))

    @cached_property
    def modes(self) -> Modes:
        """The modes of A."""
        return modes_of(self.slope_W_per_K, self.own_J_per_K)

    @property
    def others(self) -> tuple[int, ...]:
        """Terms that must be evaluated along the trajectory: all of them where a capacity changes with temperature."""
        return self.steady if self.network.capacities else self.parts.others

    @cached_property
    def steady(self) -> tuple[int, ...]:
        """Positions of all terms that are no relays."""
        relays = {position for position, _ in self.parts.relays}
        return tuple(position for position in range(len(self.network.terms)) if position not in relays)

    @cached_property
    def relays(self) -> Relays:
        """The relays, their thresholds in enthalpy."""
        if not self.parts.relays:
            return NO_RELAYS
        found = [relay for _, relay in self.parts.relays]
        nodes = np.array([r.node for r in found], dtype=np.int64)
        low, high = (self.thresholds(name)[0] for name in ("on_K", "off_K"))
        power = np.array([r.power_W for r in found], dtype=np.float64)
        return Relays(
            nodes,
            np.array([r.memory for r in found], dtype=np.int64),
            low,
            high,
            power / self.own_J_per_K[nodes],
            np.array([r.off_state_K for r in found], dtype=np.float64),
            np.array([r.on_state_K for r in found], dtype=np.float64),
            np.array([r.rate_K_per_s for r in found], dtype=np.float64),
        )

    def thresholds(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return a threshold of all relays as enthalpy, and its slope with the temperature, (n_relays,) each."""
        found = [relay for _, relay in self.parts.relays]
        points = np.tile(self.about_K, (len(found), 1))
        rows, nodes = np.arange(len(found)), np.array([r.node for r in found], dtype=np.int64)
        points[rows, nodes] = [getattr(r, name) for r in found]
        at = store(self.network, self.values, points)
        return at.enthalpy_K[rows, nodes].astype(np.float64), 1.0 / at.slope[rows, nodes]

    @cached_property
    def known(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rates that no temperature changes (n_steps, 2, n_nodes), and the factors of u less A and of u⁴."""
        shape = (self.last - self.first, 2, self.about_K.size)
        own = self.own_J_per_K
        if self.network.capacities:
            return np.zeros(shape), -self.slope_W_per_K / own[:, None], np.zeros((shape[2], shape[2]))
        linear, fourth = self.parts.linear_W_per_K, self.parts.fourth_W_per_K4
        given = self.parts.heat_W - (linear @ self.about_K + fourth @ self.about_K**4)
        return (given / own).reshape(shape), (linear - self.slope_W_per_K) / own[:, None], fourth / own[:, None]

    def beside(self, stages_K: FloatArray, first: int, last: int) -> Balance | None:
        """Evaluate the other terms at stage states (n_steps, 2, n_nodes) of some steps; None where there are none."""
        if not self.others:
            return None
        boundaries = fill_boundaries(self.network, self.values, self.forcing.boundaries_flat_K(first, last))
        along = self.forcing.along(stages_K.reshape(-1, stages_K.shape[2]), boundaries, first, last)
        return evaluate_balance(self.network, self.values, along, only=self.others)

    def remainder(
        self, beside: Balance | None, stages: FloatArray, first: int, last: int
    ) -> tuple[Remainder, FloatArray]:
        """Return r and the given rates of some steps, the other terms linearised about stage states (in enthalpy)."""
        given, linear, fourth = self.known
        given = given[first - self.first : last - self.first]
        nothing = np.zeros(0, dtype=np.int64)
        moving, at = np.zeros((last - first, 2, 0)), (nothing, nothing)
        if beside is not None:
            jacobian = beside.jacobian
            flat = stages.reshape(-1, stages.shape[2])
            rate = beside.heat_W / beside.own_J_per_K - flat @ jacobian.constant.T
            np.subtract.at(rate.T, jacobian.row, (jacobian.moving * flat[:, jacobian.column]).T)
            given, linear = given + rate.reshape(given.shape), linear + jacobian.constant
            moving, at = jacobian.moving.reshape(last - first, 2, -1), (jacobian.row, jacobian.column)
        size = np.abs(self.slope_W_per_K / self.own_J_per_K[:, None])
        row, column = entries(np.abs(linear) > 1e-14 * size)
        q_row, q_column = entries(fourth != 0.0)
        left = Remainder(
            row,
            column,
            linear[row, column],
            q_row,
            q_column,
            fourth[q_row, q_column],
            *at,
            np.ascontiguousarray(moving),
        )
        return left, np.ascontiguousarray(given)


def entries(present: BoolArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the entries of a matrix that are present, each (n_entries,) and contiguous.

    What NumPy's ``nonzero`` returns is contiguous for one entry alone, and every layout costs a compilation of its own.
    """
    row, column = np.nonzero(present)
    return np.ascontiguousarray(row), np.ascontiguousarray(column)


def less_modes(jacobian: Jacobian, slope_W_per_K: FloatArray, own: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the entries of a Jacobian less A: where they are, and (n_steps, 2, n_entries)."""
    constant = jacobian.constant - slope_W_per_K / own[:, None]
    row, column = np.nonzero(np.abs(constant) > 1e-14 * np.abs(jacobian.constant))
    n_steps = jacobian.moving.shape[0] // 2
    fixed = np.broadcast_to(constant[row, column], (n_steps, 2, row.size))
    entry = np.concatenate([fixed, jacobian.moving.reshape(n_steps, 2, -1)], axis=2)
    return np.concatenate([row, jacobian.row]), np.concatenate([column, jacobian.column]), np.ascontiguousarray(entry)


def limits(network: Network, values: FloatArray, limit_K: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Return limits of temperature as enthalpies, (n_nodes,) each."""
    lowest, highest = (to_enthalpy_K(network, values, np.full(len(network.nodes), limit)) for limit in limit_K)
    return lowest, highest


_Entries = tuple[IntArray, IntArray, IntArray, FloatArray]
"""Parameter, row, column and value of entries, (n_entries,) each."""


def turning(network: Network, values: FloatArray, forcing: Forcing, about_K: FloatArray, split: Couplings) -> Turning:
    """Return how the free parameters change C A about some temperatures."""
    parameters, own = network.parameters, values[network.capacity_index]
    slope = split.slope_W_per_K(about_K)
    position = {int(index): k for k, index in enumerate(parameters.free_index)}
    along = probe(network, values, forcing, about_K)
    found: list[_Entries] = []
    pairs: list[tuple[int, int, int, float, float]] = []
    for number, (term, index) in enumerate(zip(network.terms, network.term_indices, strict=True)):
        if number in split.others or any(number == position for position, _ in split.relays):
            continue
        for item, parameter in enumerate(index.tolist()):
            shared, size = parameters.ties.get(parameter, (parameter, 1.0))
            if shared not in position or isinstance(term, ChannelLoad | TableLoad):
                continue
            if isinstance(term, Conductors | NodeRadiation):  # by far the most, and told by their pairs
                pairs.append((shared, *term.pairs[item], size, float(isinstance(term, NodeRadiation))))
                continue
            step = DIFFERENCE * max(abs(float(values[parameter])), 1e-6)
            moved = [values[index].copy() for _ in range(2)]
            moved[0][item] -= step
            moved[1][item] += step
            low, high = (term.evaluate(along, near) for near in moved)
            block = size / (2.0 * step) * (high.d_temperature[0] - low.d_temperature[0])
            nodes = np.array(low.nodes, dtype=np.int64)
            row, column = (nodes[at] for at in np.indices(block.shape).reshape(2, -1))
            block = symmetric(block, slope[np.ix_(nodes, nodes)])
            found.append((np.full(row.size, shared), row, column, block.ravel()))
    if pairs:
        found.append(_of_pairs(slope, about_K, *np.array(pairs).T))
    mine = symmetric(slope)
    for node, parameter in enumerate(network.capacity_index.tolist()):
        shared, size = parameters.ties.get(parameter, (parameter, 1.0))
        if shared in position:
            near = np.flatnonzero(mine[node])
            value = -size * mine[node, near] / own[node]
            found.append((np.full(near.size, shared), np.full(near.size, node), near, value))
    if not found:
        return NO_TURNING
    parameter, row, column, value = (np.concatenate(parts) for parts in zip(*found, strict=True))
    kept = value != 0.0
    changed, which = np.unique(parameter[kept], return_inverse=True)
    slopes = np.array([parameters.slope(int(p), float(values[p])) for p in changed])
    columns = np.array([position[int(p)] for p in changed], dtype=np.int64)
    return Turning(columns, which, row[kept], column[kept], slopes[which] * value[kept])


def _of_pairs(
    slope_W_per_K: FloatArray,
    about_K: FloatArray,
    parameter: FloatArray,
    first: FloatArray,
    second: FloatArray,
    size: FloatArray,
    radiates: FloatArray,
) -> _Entries:
    """Return the entries of couplings between two nodes, as symmetric as the coupling is taken to be (``symmetric``)."""
    a, b = first.astype(np.int64), second.astype(np.int64)
    by_a, by_b = (
        size * np.where(radiates > 0.0, 4.0 * STEFAN_BOLTZMANN_W_PER_M2_K4 * about_K[node] ** 3, 1.0) for node in (a, b)
    )
    there, back = slope_W_per_K[a, b], slope_W_per_K[b, a]
    mutual = np.where(np.abs(there) < np.abs(back), by_b, by_a)
    mutual = np.where(np.abs(there) == np.abs(back), 0.5 * (by_a + by_b), mutual)
    mutual[~((there * back > 0.0) | ((there == back) & (by_a == by_b)))] = 0.0
    row, column = np.concatenate([a, a, b, b]), np.concatenate([a, b, a, b])
    return np.tile(parameter.astype(np.int64), 4), row, column, np.concatenate([-by_a, mutual, mutual, -by_b])
