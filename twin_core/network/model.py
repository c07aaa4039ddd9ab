"""A network ready to be evaluated: the declared specification and any added effects as terms over one parameter set."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.errors import ModelError
from twin_core.network.quantities import LEAST_MAGNITUDE, MOST_MAGNITUDE, Quantity, Tied, guess_or
from twin_core.network.spec import Channel, Conductor, Heater, Load, Node, TwinSpec
from twin_core.network.terms import (
    BoundaryConductor,
    BoundaryTerm,
    CapacityTerm,
    ChannelLoad,
    Conductors,
    NodeRadiation,
    OneWayConductor,
    ProportionalHeat,
    ReadingTerm,
    SinkRadiation,
    TableLoad,
    Term,
)
from twin_core.network.thermostat import Memory, ThermostatHeat
from twin_core.parameters.parameter import (
    GUESS_LOG_STD,
    NO_GUESS_LOG_STD,
    Parameter,
    absolute_temperature,
    positive,
    real,
)
from twin_core.parameters.transforms import Log
from twin_core.parameters.vector import ParameterSet

ARITHMETIC_S, ROOM_K = 1e-3, 293.0
"""Time constant of a node that stores nothing: it lags by this times the rate of its neighbours, microkelvins in orbit, and
keeps ten digits of the slow modes in the eigenvalues. Radiation counts as at room temperature."""

MEMORY_S, APPROACH_K_PER_S = 0.1, 1e-3
"""Of a declared thermostat: how fast its memory follows, and how fast its node came to a threshold before a record began."""

SINK_STD_K = 50.0
"""Prior standard deviation of an unknown sink whose guess comes without a spread."""


@dataclass(frozen=True)
class ExtraNode:
    """A state that an effect adds.

    Attributes
    ----------
    name
        Unique among the nodes.
    capacity
        Its capacity as a parameter.
    like
        The node whose initial temperature it starts from.
    reads
        The sensor that reads this state instead of its node; None for most.
    follows
        The boundary at whose first temperature it starts, known; None for most.
    """

    name: str
    capacity: Parameter
    like: str
    reads: str | None = None
    follows: str | None = None


@dataclass(frozen=True)
class Addition:
    """What one effect adds to a network."""

    terms: tuple[Term, ...] = ()
    capacities: tuple[CapacityTerm, ...] = ()
    readings: tuple[ReadingTerm, ...] = ()
    boundaries: tuple[BoundaryTerm, ...] = ()
    nodes: tuple[ExtraNode, ...] = ()
    dated: bool | None = None
    """Whether the instants that it knows are dates or a file's own seconds; None where it knows no instant."""


class Extension(Protocol):
    """Anything that can extend a network: an effect."""

    @property
    def label(self) -> str:
        """A name, unique in the model, that prefixes its parameters."""
        ...

    def extra_nodes(self, layout: "Layout") -> tuple[ExtraNode, ...]:
        """Return the states that it adds."""
        ...

    def addition(self, layout: "Layout") -> Addition:
        """Return its terms over the final layout."""
        ...


@dataclass(frozen=True)
class Layout:
    """Names and positions in a network: all that an effect needs to know of it."""

    spec: TwinSpec
    nodes: tuple[str, ...]
    boundaries: tuple[str, ...]
    table_knots: Mapping[tuple[str, str], tuple[float, ...]]

    def node(self, name: str) -> int:
        """Return the position of a node; ModelError if there is none of that name."""
        if name not in self._node_index:
            raise ModelError(f"unknown node '{name}' (known: {', '.join(self.nodes)})")
        return self._node_index[name]

    @cached_property
    def _node_index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.nodes)}

    def boundary(self, name: str) -> int:
        """Return the position of a boundary; ModelError if there is none of that name."""
        if name not in self.boundaries:
            raise ModelError(f"unknown boundary '{name}' (known: {', '.join(self.boundaries)})")
        return self.boundaries.index(name)

    def sensor(self, name: str) -> int:
        """Return the position of a sensor; ModelError if there is none of that name."""
        if name not in self.spec.sensors:
            raise ModelError(f"unknown sensor '{name}' (known: {', '.join(self.spec.sensors)})")
        return self.spec.sensors.index(name)

    def sensor_node(self, name: str) -> str:
        """Return the node that a sensor reads."""
        return self._sensor_nodes[name]

    @cached_property
    def _sensor_nodes(self) -> dict[str, str]:
        return {sensor: node.id for node in self.spec.nodes for sensor in node.sensors}

    @property
    def declared_nodes(self) -> tuple[str, ...]:
        """The nodes of the specification, without those that effects added."""
        return tuple(node.id for node in self.spec.nodes)

    @property
    def node_pairs(self) -> set[frozenset[str]]:
        """The pairs of nodes, or node and boundary, that a declared conductor joins."""
        return {frozenset(c.between) for c in self.spec.conductors if c.into is None}

    @property
    def surfaces(self) -> list[tuple[str, str]]:
        """(node, boundary) of every declared conductor or radiator to a boundary, each once."""
        ends = [tuple(c.between) for c in self.spec.conductors]
        pairs = [(a, b) for x, y in ends for a, b in ((x, y), (y, x)) if b in self.boundaries]
        return list(dict.fromkeys([*pairs, *((r.node, r.sink) for r in self.spec.radiators)]))

    def loads_of(self, channel: str) -> tuple[Load, ...]:
        """Return the declared loads that a channel drives."""
        return tuple(load for load in self.spec.loads if load.channel == channel)


def conductor_name(between: Sequence[str]) -> str:
    """Return the name of a declared symmetric conductance, such as ``G:px|tank``."""
    return f"G:{between[0]}|{between[1]}"


def gain_name(load: Load) -> str:
    """Return the name of the gain of a declared load, such as ``gain:H1|tank``."""
    return f"gain:{_driven_by(load)}|{load.node}"


def _driven_by(load: Load) -> str:
    return load.channel if load.factor is None else f"{load.channel}*{load.factor}"


def radiator_name(node: str, sink: str) -> str:
    """Return the name of the exchange area of a declared radiator, such as ``R:px|space``."""
    return f"R:{node}|{sink}"


def _quantity(name: str, unit: str, quantity: Quantity | None, default: float) -> Parameter:
    """Return the parameter of a declared quantity; an undeclared one starts from ``default`` with a flat prior.

    The value of a tied one is its size until the parameter set makes it follow.
    """
    if isinstance(quantity, Tied) and quantity.tie is not None:
        shared, size = quantity.tie
        return replace(positive(name, unit, size, prior_std=None), tied_to=shared, size=size)
    value = guess_or(quantity, default)
    known = quantity is not None and quantity.value is not None
    declared = quantity is not None and quantity.guess is not None
    bounds = None if quantity is None else quantity.bounds
    prior = GUESS_LOG_STD if declared else NO_GUESS_LOG_STD
    parameter = positive(
        name, unit, value, bounds=bounds, prior_std=prior, frozen=known, guessed=not (known or declared)
    )
    if bounds is None:
        parameter = replace(parameter, transform=Log(upper=MOST_MAGNITUDE, lower=LEAST_MAGNITUDE))
    if quantity is None or quantity.spread is None:
        return parameter
    log_slope = parameter.transform.slope(parameter.free) / value  # one where the solver's number is the logarithm
    return replace(parameter, prior_std=math.log(quantity.spread) / log_slope)


@dataclass(frozen=True)
class Network:
    """Declared terms and effects over one parameter set.

    Attributes
    ----------
    layout
        Names and positions of nodes (n_nodes) and boundaries (n_boundaries).
    parameters
        Every number of the model: capacities, conductances, gains, tables, unknown sinks, effects.
    terms, capacities, readings
        The heat balance, temperature-dependent capacity, and sensor faults.
    boundary_terms
        What effects make of boundary temperatures, in the order in which they act.
    sensor_node : (n_sensors,)
        Position of the state that each sensor reads.
    extra
        States that effects added.
    dated
        Whether instants in the effects are dates or a file's own seconds; None where they know none.
    """

    layout: Layout
    parameters: ParameterSet
    terms: tuple[Term, ...]
    capacities: tuple[CapacityTerm, ...]
    readings: tuple[ReadingTerm, ...]
    sensor_node: IntArray
    extra: tuple[ExtraNode, ...]
    dated: bool | None = None
    boundary_terms: tuple[BoundaryTerm, ...] = ()

    @property
    def spec(self) -> TwinSpec:
        """The declared specification."""
        return self.layout.spec

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of all states."""
        return self.layout.nodes

    @cached_property
    def capacity_index(self) -> IntArray:
        """Position of each node's capacity among the parameters, (n_nodes,)."""
        index = self.parameters.index
        names = {node.name: node.capacity.name for node in self.extra}
        return np.array([index[names.get(name, f"C:{name}")] for name in self.nodes], dtype=np.int64)

    @cached_property
    def boundary_index(self) -> IntArray:
        """Position of each boundary's unknown temperature among the parameters, (n_boundaries,); -1 where given."""
        index = self.parameters.index
        return np.array([index.get(f"T:{name}", -1) for name in self.layout.boundaries], dtype=np.int64)

    def term_index(self, term: Term | CapacityTerm | ReadingTerm | BoundaryTerm) -> IntArray:
        """Return the positions of a term's own and borrowed parameters."""
        index = self.parameters.index
        names = [p.name for p in term.parameters] + list(term.borrows)
        return np.array([index[name] for name in names], dtype=np.int64)

    @cached_property
    def term_indices(self) -> tuple[IntArray, ...]:
        """``term_index`` of every heat term."""
        return tuple(self.term_index(term) for term in self.terms)

    def with_values(self, values: FloatArray) -> "Network":
        """Return the network at other parameter values, (n_parameters,)."""
        return self.with_parameters(self.parameters.at_values(values))

    def with_parameters(self, parameters: ParameterSet) -> "Network":
        """Return the network with another parameter set over the same names."""
        return replace(self, parameters=parameters)


def build_network(
    spec: TwinSpec,
    effects: Iterable[Extension] = (),
    *,
    table_knots: Mapping[tuple[str, str], tuple[float, ...]] | None = None,
    defaults: Mapping[str, float] | None = None,
) -> Network:
    """Return the network of a specification with effects added.

    Parameters
    ----------
    spec
        The declared network.
    effects
        Terms that the declared network lacks.
    table_knots
        (channel, node) -> knots of tables whose levels are read from telemetry.
    defaults
        Parameter name -> starting value of what nobody declared.

    Raises
    ------
    ModelError
        If an effect names a node, boundary, sensor or channel that the network lacks.
    """
    effects = tuple(effects)
    knots = dict(table_knots or {})
    bare = Layout(spec, tuple(node.id for node in spec.nodes), tuple(spec.boundaries), knots)
    extra = (*heater_nodes(spec), *(node for effect in effects for node in effect.extra_nodes(bare)))
    layout = Layout(spec, bare.nodes + tuple(node.name for node in extra), bare.boundaries, knots)
    additions = [effect.addition(layout) for effect in effects]
    terms = (*declared_terms(layout), *(t for a in additions for t in a.terms))
    capacities = tuple(c for a in additions for c in a.capacities)
    readings = tuple(r for a in additions for r in a.readings)
    surroundings = tuple(sorted((b for a in additions for b in a.boundaries), key=lambda term: term.rank))
    parameters: list[Parameter] = [_capacity(spec, node) for node in spec.nodes]
    parameters += [
        absolute_temperature(f"T:{name}", b.guess_K, prior_std_K=b.spread or SINK_STD_K)
        for name, b in spec.boundaries.items()
        if b.guess_K is not None
    ]
    units = {tie[0]: unit for _, tie, unit in spec.ties}
    parameters += [_quantity(name, units[name], shared, 1.0) for name, shared in spec.parameters.items()]
    parameters += [node.capacity for node in extra]
    for group in (terms, capacities, readings, surroundings):
        parameters += [p for term in group for p in term.parameters]
    unique = tuple({p.name: p for p in parameters}.values())
    reads = {node.reads: layout.node(node.name) for node in extra if node.reads is not None}
    sensor_node = [reads.get(s, layout.node(layout.sensor_node(s))) for s in spec.sensors]
    guessed = {p.name for p in unique if p.guessed}
    start = {name: value for name, value in (defaults or {}).items() if name in guessed}
    return Network(
        layout,
        ParameterSet(unique).updated(start),
        terms,
        capacities,
        readings,
        np.array(sensor_node, dtype=np.int64),
        extra,
        next((a.dated for a in additions if a.dated is not None), None),
        surroundings,
    )


def _capacity(spec: TwinSpec, node: Node) -> Parameter:
    """Return the capacity of a declared node.

    One that stores nothing gets what makes it follow its neighbours within ``ARITHMETIC_S``: the exponential integrator
    takes such a node to its balance in any step, and nothing else of it needs another path.
    """
    quantity = node.capacity_J_per_K
    if quantity is None or quantity.value != 0.0:
        return _quantity(f"C:{node.id}", "J/K", quantity, 1.0e4)
    cube = 4.0 * STEFAN_BOLTZMANN_W_PER_M2_K4 * ROOM_K**3
    joined = [guess_or(c.conductance_W_per_K, 1.0) for c in spec.conductors if node.id in c.between]
    joined += [cube * guess_or(r.area_m2, 1e-3) for r in spec.radiation if node.id in r.between]
    joined += [cube * r.emissivity * r.area_m2 for r in spec.radiators if r.node == node.id]
    return positive(f"C:{node.id}", "J/K", ARITHMETIC_S * (sum(joined) or 1.0), frozen=True)


def told_values(network: Network) -> dict[str, float]:
    """Return name -> value of every parameter as it is told: 0 for a capacity declared as nothing, whatever stands for it."""
    nothing = {f"C:{n.id}": 0.0 for n in network.spec.nodes if n.capacity_J_per_K and n.capacity_J_per_K.value == 0.0}
    return network.parameters.as_dict() | nothing


def declared_terms(layout: Layout) -> list[Term]:
    """Return the terms of the specification."""
    spec = layout.spec
    terms: list[Term] = []
    inner = [c for c in spec.conductors if not set(c.between) & set(layout.boundaries) and c.into is None]
    if inner:
        pairs = tuple((layout.node(c.between[0]), layout.node(c.between[1])) for c in inner)
        conductances = tuple(_conductance(c) for c in inner)
        terms.append(Conductors(pairs, conductances, len(layout.nodes)))
    for conductor in spec.conductors:
        outer = [end for end in conductor.between if end in layout.boundaries]
        if outer:
            node = next(end for end in conductor.between if end not in layout.boundaries)
            terms.append(BoundaryConductor(layout.node(node), layout.boundary(outer[0]), (_conductance(conductor),)))
        elif conductor.into is not None:
            source = next(end for end in conductor.between if end != conductor.into)
            terms.append(OneWayConductor(layout.node(conductor.into), layout.node(source), (_conductance(conductor),)))
    for radiator in spec.radiators:
        area = radiator.emissivity * radiator.area_m2
        parameter = positive(radiator_name(radiator.node, radiator.sink), "m2", area, frozen=True)
        terms.append(SinkRadiation(layout.node(radiator.node), layout.boundary(radiator.sink), (parameter,)))
    terms += _radiation_terms(layout)
    terms += [_load_term(layout, load) for load in spec.loads]
    terms += [_heater_term(layout, heater) for heater in spec.heaters]
    return terms


def _conductance(conductor: Conductor) -> Parameter:
    return _quantity(conductor.name, "W/K", conductor.conductance_W_per_K, 1.0)


def _radiation_terms(layout: Layout) -> Iterator[Term]:
    """Yield the declared radiation: between nodes as one term, to each boundary as one of its own."""
    sinks = set(layout.boundaries)
    outer = [r for r in layout.spec.radiation if sinks & set(r.between)]
    inner = [r for r in layout.spec.radiation if not sinks & set(r.between)]
    parameters = {r.name: _quantity(r.name, "m2", r.area_m2, 1e-3) for r in layout.spec.radiation}
    if inner:
        pairs = tuple((layout.node(r.between[0]), layout.node(r.between[1])) for r in inner)
        yield NodeRadiation(pairs, tuple(parameters[r.name] for r in inner), len(layout.nodes))
    for coupling in outer:
        node, sink = sorted(coupling.between, key=lambda end: end in layout.boundaries)
        yield SinkRadiation(layout.node(node), layout.boundary(sink), (parameters[coupling.name],))


def heater_nodes(spec: TwinSpec) -> tuple[ExtraNode, ...]:
    """Return the states that remember whether the declared thermostats are on."""
    unit = positive("", "J/K", 1.0, frozen=True)
    return tuple(
        ExtraNode(heater.name, replace(unit, name=f"C:{heater.name}"), heater.controlled_by)
        for heater in spec.heaters
        if heater.thermostat is not None
    )


def _heater_term(layout: Layout, heater: Heater) -> Term:
    """Return the term of a declared heater; its temperatures are held, its power or gain are as they are declared."""
    node, control = layout.node(heater.node), layout.node(heater.controlled_by)
    if heater.thermostat is not None:
        law = heater.thermostat
        switched = (
            _quantity(f"{heater.name}.Q", "W", law.power_W, 1.0),
            real(f"{heater.name}.T_on", "K", law.on_K, frozen=True),
            real(f"{heater.name}.T_off", "K", law.off_K, frozen=True),
        )
        memory = Memory(law.on_K, law.off_K, MEMORY_S)
        return ThermostatHeat(node, layout.node(heater.name), APPROACH_K_PER_S, memory, switched)
    proportional = heater.proportional
    assert proportional is not None
    parameters: tuple[Parameter, ...] = (
        _quantity(f"{heater.name}.k", "W/K", proportional.gain_W_per_K, 1.0),
        real(f"{heater.name}.T_set", "K", proportional.set_K, frozen=True),
    )
    if proportional.most_W is not None:
        parameters = (*parameters, _quantity(f"{heater.name}.Q", "W", proportional.most_W, 1.0))
    return ProportionalHeat(node, parameters, (), None if control == node else control)


def _load_term(layout: Layout, load: Load) -> Term:
    """Return the term of one declared load; a gain is known (one) unless it is declared or the channel is in percent."""
    channel: Channel = layout.spec.inputs[load.channel]
    node = layout.node(load.node)
    if load.table is not None:
        key = (load.channel, load.node)
        knots = load.table.knots or layout.table_knots.get(key)
        if knots is None:
            raise ModelError(f"load '{load.channel}' on '{load.node}': the levels of its table are not known yet")
        table, told = load.table, load.table.values_W or load.table.guess_W or (0.0,) * len(knots)
        values = tuple(
            real(
                f"table:{_driven_by(load)}|{load.node}[{k:g}]",
                "W",
                value,
                prior_std=None if table.guess_W is None else table.spread_W or GUESS_LOG_STD * abs(value) or None,
                frozen=table.values_W is not None,
            )
            for k, value in zip(knots, told, strict=True)
        )
        solar, weight = load.solar, load.weight
        return TableLoad(node, load.channel, tuple(knots), channel.levels, weight, solar, values, (), load.factor)
    unknown = load.gain is not None or channel.unit != "W"
    unit = {"percent": "W/%", "W/m2": "m2"}.get(channel.unit or "", "")
    gain = (
        _quantity(gain_name(load), unit, load.gain, 1.0)
        if unknown
        else positive(gain_name(load), unit, 1.0, frozen=True)
    )
    return ChannelLoad(node, load.channel, load.weight, load.solar, (gain,), (), load.factor)
