"""Terms of the heat balance: what flows into which node, and how it changes with temperature and parameters.

Every term, declared or discovered, answers one question at many points at once: ``evaluate(along, values)`` returns the
heat into the nodes that it touches together with exact derivatives. The time loop never calls a term; it sees arrays.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.parameters.parameter import Parameter


@dataclass(frozen=True)
class Along:
    """The points at which a heat balance is evaluated.

    Attributes
    ----------
    time_s : (n_points,)
        On the clock of ``Record.clock_s``: an instant is the same number in every record.
    temperatures_K : (n_points, n_nodes)
    boundaries_K : (n_points, n_boundaries)
    inputs : channel -> (n_points,)
        Power in W (or percent), auxiliary channels in their own unit.
    sun_factor : (n_points,)
        (1 AU / Sun distance)^2; ones where no load is solar.
    derivatives
        Whether parameter derivatives are wanted: a term for which they are dear may leave them out where not.
    given_K : (n_points, n_boundaries)
        The boundaries as they are declared, where an effect has changed them; None where ``boundaries_K`` are those.
    """

    time_s: FloatArray
    temperatures_K: FloatArray
    boundaries_K: FloatArray
    inputs: Mapping[str, FloatArray]
    sun_factor: FloatArray
    derivatives: bool = True
    given_K: FloatArray | None = None

    @property
    def declared_K(self) -> FloatArray:
        """The boundaries as they are declared, (n_points, n_boundaries)."""
        return self.boundaries_K if self.given_K is None else self.given_K


class Entry(NamedTuple):
    """A derivative series: of the quantity at ``node`` (its position in the network) with respect to an item."""

    item: int
    node: int
    series: FloatArray


class Relay(NamedTuple):
    """A heat that is switched by a temperature: on below one threshold, off above another, else as it was.

    Attributes
    ----------
    node, memory
        Whose temperature switches it and which state of unit capacity remembers it.
    power_W, on_K, off_K
        Its values, the first three of its term.
    off_state_K, on_state_K
        What the memory is where it is off and on; in between it stands for a share of full power.
    rate_K_per_s
        How fast the node comes to a threshold: tells how long ago one was passed that lies behind when a record begins.
    """

    node: int
    memory: int
    power_W: float
    on_K: float
    off_K: float
    off_state_K: float
    on_state_K: float
    rate_K_per_s: float


@dataclass(frozen=True)
class Heat:
    """Heat of one term and its derivatives.

    Attributes
    ----------
    nodes : (n_local,)
        The nodes that the term touches.
    heat_W : (n_points, n_local)
    d_temperature : (n_points or 1, n_local, n_local)
        d heat_W[:, a] / d temperature of nodes[b] at the same point. A heat that is shared out over both points of a step
        (a relay) gives at each what the sum over both changes with the temperature there. Of size 0 for many nodes
        at once, where ``fourth_W_per_K4`` tells all.
    d_values
        Entries whose item counts the term's ``parameters`` first, then what it ``borrows``.
    d_boundaries
        Entries whose item is the boundary.
    fourth_W_per_K4 : (n_local, n_local)
        Where all of the heat that depends on temperature is this constant matrix times T⁴; None for other heats. A heat
        with one ``d_temperature`` for all of several points is that matrix times T.
    relay
        What switches the heat, for the integrator, which locates the instants itself.
    """

    nodes: tuple[int, ...]
    heat_W: FloatArray
    d_temperature: FloatArray
    d_values: list[Entry] = field(default_factory=list)
    d_boundaries: list[Entry] = field(default_factory=list)
    fourth_W_per_K4: FloatArray | None = None
    relay: Relay | None = None


class Term(Protocol):
    """A heat flow. ``values`` are its own parameters followed by those it borrows from the network by name."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its own parameters."""
        ...

    @property
    def borrows(self) -> tuple[str, ...]:
        """Names of network parameters that it needs too."""
        ...

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Return heat and derivatives at the given points."""
        ...


@dataclass(frozen=True)
class Capacity:
    """Extra capacity of one node: (n_points,) in J/K, its slope in J/K^2, and parameter derivatives.

    ``stored_J`` is its integral over temperature, from wherever; ``d_stored`` are that integral's parameter derivatives.
    """

    node: int
    extra_J_per_K: FloatArray
    d_temperature: FloatArray
    d_values: list[Entry]
    stored_J: FloatArray
    d_stored: list[Entry]


class CapacityTerm(Protocol):
    """A temperature-dependent addition to the capacity of one node."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its own parameters."""
        ...

    @property
    def borrows(self) -> tuple[str, ...]:
        """Names of network parameters that it needs too."""
        ...

    @property
    def node(self) -> int:
        """The node that has it."""
        ...

    def evaluate(self, temperature_K: FloatArray, values: FloatArray) -> Capacity:
        """Return the extra capacity and derivatives at temperatures (n_points,) of its node."""
        ...


@dataclass(frozen=True)
class Reading:
    """What a sensor reads beyond the temperature of its node: (n_times,) in K, with derivatives (value index, series)."""

    sensor: int
    offset_K: FloatArray
    d_values: list[tuple[int, FloatArray]]


class ReadingTerm(Protocol):
    """A fault of one sensor, as an offset over time."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its own parameters."""
        ...

    @property
    def borrows(self) -> tuple[str, ...]:
        """Names of network parameters that it needs too."""
        ...

    def evaluate(self, time_s: FloatArray, values: FloatArray) -> Reading:
        """Return the offset and derivatives at the sample times, on the clock of ``Record.clock_s``."""
        ...


@dataclass(frozen=True)
class Sink:
    """What an effect makes of the temperature of one boundary, with its derivatives.

    Attributes
    ----------
    temperature_K : (n_points,)
        What everything that reads the boundary sees.
    d_given : (n_points,)
        Its derivative by the temperature that was there before.
    d_values
        (value index, (n_points,)).
    d_states
        (node, (n_points,)): where the temperature is that of a state.
    """

    temperature_K: FloatArray
    d_given: FloatArray
    d_values: list[tuple[int, FloatArray]] = field(default_factory=list)
    d_states: list[tuple[int, FloatArray]] = field(default_factory=list)


class BoundaryTerm(Protocol):
    """A change of the temperature that a boundary has for all that reads it."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its own parameters."""
        ...

    @property
    def borrows(self) -> tuple[str, ...]:
        """Names of network parameters that it needs too."""
        ...

    @property
    def boundary(self) -> int:
        """The boundary whose temperature it changes."""
        ...

    @property
    def rank(self) -> int:
        """Of several on one boundary the lower ones act first: a delay is one of the channel itself."""
        ...

    def evaluate(self, given_K: FloatArray, along: Along, values: FloatArray) -> Sink:
        """Return the temperature and its derivatives, for the temperature (n_points,) that is there before."""
        ...


def pair_jacobian(d_first: FloatArray, d_second: FloatArray) -> FloatArray:
    """Return (n_points, 2, 2) for an exchange q into the first node and -q into the second, from dq/dT of both."""
    return np.stack([np.stack([d_first, d_second], -1), np.stack([-d_first, -d_second], -1)], axis=-2)


@dataclass(frozen=True)
class Conductors:
    """All declared linear conductors between nodes at once: q_a = G (T_b - T_a), symmetric by construction."""

    pairs: tuple[tuple[int, int], ...]
    parameters: tuple[Parameter, ...]
    n_nodes: int
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate every conductor; the Jacobian is the negative weighted graph Laplacian (paper A, eq. 1).

        Symmetric and without row sums, it keeps the heat content and lets T'CT/2 fall (eqs. 5 to 11).
        """
        first, second = np.array(self.pairs).T
        laplacian = np.zeros((self.n_nodes, self.n_nodes))
        np.add.at(laplacian, (first, second), -values)
        laplacian += laplacian.T
        np.fill_diagonal(laplacian, -laplacian.sum(axis=1))
        temperatures = along.temperatures_K
        heat = (
            temperatures[:, :1] - temperatures
        ) @ laplacian  # differences, so that equal temperatures exchange nothing
        entries = []
        for edge, (a, b) in enumerate(self.pairs if along.derivatives else ()):
            difference = temperatures[:, b] - temperatures[:, a]
            entries += [Entry(edge, a, difference), Entry(edge, b, -difference)]
        return Heat(tuple(range(self.n_nodes)), heat, -laplacian[None], entries)


@dataclass(frozen=True)
class BoundaryConductor:
    """A linear conductor from a node to a boundary: q = G (T_boundary - T)."""

    node: int
    boundary: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the conductor."""
        conductance = values[0]
        difference = along.boundaries_K[:, self.boundary] - along.temperatures_K[:, self.node]
        flat = np.full(difference.shape, conductance)
        return Heat(
            (self.node,),
            (conductance * difference)[:, None],
            np.full((1, 1, 1), -conductance),
            [Entry(0, self.node, difference)],
            [Entry(self.boundary, self.node, flat)],
        )


@dataclass(frozen=True)
class SinkRadiation:
    """Radiation to a boundary: q = sigma R (T_s^4 - T^4), R = emissivity * area (paper A, section 2.3)."""

    node: int
    boundary: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the radiation."""
        temperature = along.temperatures_K[:, self.node]
        sink = along.boundaries_K[:, self.boundary]
        square, sink_square = temperature * temperature, sink * sink  # powers of floats are dear
        unit = STEFAN_BOLTZMANN_W_PER_M2_K4 * (sink_square * sink_square - square * square)
        slope = 4.0 * STEFAN_BOLTZMANN_W_PER_M2_K4 * values[0]
        return Heat(
            (self.node,),
            (values[0] * unit)[:, None],
            (-slope * square * temperature)[:, None, None],
            [Entry(0, self.node, unit)],
            [Entry(self.boundary, self.node, slope * sink_square * sink)],
            np.full((1, 1), -STEFAN_BOLTZMANN_W_PER_M2_K4 * values[0]),
        )


@dataclass(frozen=True)
class OneWayConductor:
    """A conductor that only one node feels: q = G (T_source - T); the source gives nothing."""

    node: int
    source: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the conductor."""
        difference = along.temperatures_K[:, self.source] - along.temperatures_K[:, self.node]
        heat = np.stack([values[0] * difference, np.zeros_like(difference)], axis=1)
        slope = values[0] * np.array([[[-1.0, 1.0], [0.0, 0.0]]])
        return Heat((self.node, self.source), heat, slope, [Entry(0, self.node, difference)])


@dataclass(frozen=True)
class NodeRadiation:
    """All declared radiation between nodes at once: q_a = -q_b = sigma R (T_b^4 - T_a^4)."""

    pairs: tuple[tuple[int, int], ...]
    parameters: tuple[Parameter, ...]
    n_nodes: int
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate every coupling: a weighted graph Laplacian on T^4; what one node gains the others lose."""
        first, second = np.array(self.pairs).T
        laplacian = np.zeros((self.n_nodes, self.n_nodes))
        np.add.at(laplacian, (first, second), -STEFAN_BOLTZMANN_W_PER_M2_K4 * values)
        laplacian += laplacian.T
        np.fill_diagonal(laplacian, -laplacian.sum(axis=1))
        square = along.temperatures_K * along.temperatures_K
        fourth = square * square
        heat = (fourth[:, :1] - fourth) @ laplacian  # differences, so that equal temperatures exchange nothing
        entries = []
        for edge, (a, b) in enumerate(self.pairs if along.derivatives else ()):
            unit = STEFAN_BOLTZMANN_W_PER_M2_K4 * (fourth[:, b] - fourth[:, a])
            entries += [Entry(edge, a, unit), Entry(edge, b, -unit)]
        return Heat(tuple(range(self.n_nodes)), heat, np.zeros((0, 0, 0)), entries, fourth_W_per_K4=-laplacian)


@dataclass(frozen=True)
class ProportionalHeat:
    """q = min(Q, k (T_set - T)) below T_set, else 0; values are k, T_set, Q, without Q where there is no limit.

    T is the temperature of ``control``, that of the heated node itself where it is None.
    """

    node: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()
    control: int | None = None

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the heater; at k = 0 the derivative by k is that of a heater limited to Q = k (T_set - T_full)."""
        gain, set_point = values[:2]
        limit = values[2] if values.size > 2 else np.inf
        control = self.node if self.control is None else self.control
        below = np.maximum(set_point - along.temperatures_K[:, control], 0.0)
        full = gain * below >= limit
        heated = (below > 0.0) & ~full
        zero = np.zeros_like(below)
        heat, slope = np.where(full, limit, gain * below), np.where(heated, -gain, 0.0)
        entries = [Entry(0, self.node, np.where(full, zero, below)), Entry(1, self.node, np.where(heated, gain, 0.0))]
        if values.size > 2:
            entries.append(Entry(2, self.node, np.where(full, 1.0, zero)))
        if control == self.node:
            return Heat((self.node,), heat[:, None], slope[:, None, None], entries)
        jacobian = np.stack([np.stack([zero, slope], -1), np.stack([zero, zero], -1)], axis=-2)
        return Heat((self.node, control), np.stack([heat, zero], axis=1), jacobian, entries)


@dataclass(frozen=True)
class ChannelLoad:
    """A declared heat input: q = gain * weight * u(t), times (1 AU / Sun distance)^2 where solar, times ``factor``."""

    node: int
    channel: str
    weight: float
    solar: bool
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()
    factor: str | None = None

    def unit_heat(self, along: Along) -> FloatArray:
        """Return the heat at gain one, (n_points,)."""
        unit = self.weight * along.inputs[self.channel]
        if self.factor is not None:
            unit = unit * along.inputs[self.factor]
        return unit * along.sun_factor if self.solar else unit

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the load."""
        unit = self.unit_heat(along)
        return Heat((self.node,), (values[0] * unit)[:, None], np.zeros((1, 1, 1)), [Entry(0, self.node, unit)])


@dataclass(frozen=True)
class TableLoad:
    """Heat as a function of an auxiliary channel: hat functions over knots, or one value per level.

    Where ``visits`` tell the share of a record that each value counts for, it is the heat about its mean over that record.
    """

    node: int
    channel: str
    knots: tuple[float, ...]
    levels: bool
    weight: float
    solar: bool
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()
    factor: str | None = None
    visits: tuple[float, ...] = field(default=(), kw_only=True)

    def basis(self, along: Along) -> FloatArray:
        """Return how much each value counts at each point, (n_points, n_values)."""
        basis = table_basis(along.inputs[self.channel], self.knots, self.levels)
        return basis - np.array(self.visits) if self.visits else basis

    def looked_up(self, along: Along, values: FloatArray) -> FloatArray:
        """Return the table at each point, (n_points,): ``basis @ values`` without the basis."""
        heat = table_values(along.inputs[self.channel], self.knots, values, self.levels)
        return heat - np.dot(self.visits, values) if self.visits else heat

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the table; it is linear in its values."""
        scale = np.full(along.time_s.size, self.weight)
        if self.solar:
            scale *= along.sun_factor
        if self.factor is not None:
            scale *= along.inputs[self.factor]
        if not along.derivatives:
            return Heat((self.node,), (scale * self.looked_up(along, values))[:, None], np.zeros((1, 1, 1)), [])
        basis = scale[:, None] * self.basis(along)
        entries = [Entry(i, self.node, basis[:, i]) for i in range(len(self.parameters))]
        return Heat((self.node,), (basis @ values)[:, None], np.zeros((1, 1, 1)), entries)


@dataclass(frozen=True)
class SteeredTable(TableLoad):
    """A table over one channel for each state of another: ``states`` tells the state that each knot belongs to.

    The channel ``state`` rests at ``rests``; in a state without knots there is no heat.
    """

    states: tuple[float, ...] = ()
    state: str = ""
    rests: tuple[float, ...] = ()

    def basis(self, along: Along) -> FloatArray:
        """Return how much each value counts at each point, (n_points, n_values)."""
        x = along.inputs[self.channel]
        basis = np.zeros((x.size, len(self.knots)))
        for rows, own, knots in self._by_state(along):
            basis[np.ix_(rows, own)] = table_basis(x[rows], knots, self.levels)
        return basis

    def looked_up(self, along: Along, values: FloatArray) -> FloatArray:
        """Return the table at each point, (n_points,)."""
        x = along.inputs[self.channel]
        out = np.zeros(x.size)
        for rows, own, knots in self._by_state(along):
            out[rows] = table_values(x[rows], knots, values[own], self.levels)
        return out

    def _by_state(self, along: Along) -> Iterator[tuple[IntArray, IntArray, tuple[float, ...]]]:
        """Yield the points in each state that has knots, the positions of these, and them."""
        now = nearest(along.inputs[self.state], self.rests)
        for k, rest in enumerate(self.rests):
            own = np.flatnonzero(np.array(self.states) == rest)
            if own.size:
                yield np.flatnonzero(now == k), own, tuple(self.knots[i] for i in own)


def nearest(x: FloatArray, places: Sequence[float]) -> IntArray:
    """Return which place each point is nearest to, (n_points,)."""
    return np.asarray(np.argmin(np.abs(x[:, None] - np.asarray(places, dtype=np.float64)), axis=1))


def table_values(x: FloatArray, knots: tuple[float, ...], values: FloatArray, levels: bool) -> FloatArray:
    """Return ``table_basis(x, knots, levels) @ values``, (n_points,)."""
    return values[nearest(x, knots)] if levels else np.interp(x, knots, values)


def table_basis(x: FloatArray, knots: tuple[float, ...], levels: bool) -> FloatArray:
    """Return the basis of a table, (n_points, n_knots): rows add to one.

    Hat functions over the knots, constant beyond the ends; for levels the indicator of the nearest one.
    """
    points = np.asarray(knots, dtype=np.float64)
    if levels:
        return (nearest(x, knots)[:, None] == np.arange(points.size)).astype(np.float64)
    basis = np.zeros((x.size, points.size))
    if points.size == 1:
        return np.ones_like(basis)
    inside = np.clip(x, points[0], points[-1])
    left = np.clip(np.searchsorted(points, inside, side="right") - 1, 0, points.size - 2)
    share = (inside - points[left]) / (points[left + 1] - points[left])
    rows = np.arange(x.size)
    basis[rows, left] = 1.0 - share
    basis[rows, left + 1] += share
    return basis
