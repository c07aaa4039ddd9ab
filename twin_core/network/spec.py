"""The twin specification: what the operator declares, and whether it fits together."""

from collections.abc import Iterable, Mapping
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, StrictBool, field_validator, model_validator
from pydantic_core import PydanticCustomError

from twin_core.errors import TelemetryError
from twin_core.network.orbit_block import PREFIX, OrbitBlock
from twin_core.network.quantities import (
    TWIN_ID,
    Conductance,
    Fraction,
    HeatCapacity,
    Magnitude,
    Name,
    Number,
    Positive,
    Quantity,
    Strict,
    Temperature,
)
from twin_core.units import parse_instant_ns

REFERENCES = "references"
"""The kind of a validation error that carries all broken references of a specification as ``problems``."""


class Boundary(Strict):
    """A temperature that is given: a constant, a telemetry channel, or one unknown constant with a guess."""

    value_K: Temperature | None = None
    channel: Name | None = None
    guess_K: Temperature | None = None
    spread: Positive | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.spread is not None and self.guess_K is None:
            raise ValueError("spread says by how many K a guess may be off; give 'guess_K' with it")
        if sum(item is not None for item in (self.value_K, self.channel, self.guess_K)) != 1:
            raise ValueError("give exactly one of 'value_K', 'channel', 'guess_K'")
        return self


Ends = tuple[Number | None, Number | None]


class Limits(Strict):
    """Where a channel should stay (yellow) and must stay (red), in its own unit; null where a side has no limit."""

    yellow: Ends | None = None
    red: Ends | None = None

    @model_validator(mode="after")
    def _nested(self) -> Self:
        for colour, ends in (("yellow", self.yellow), ("red", self.red)):
            if ends is not None and ends == (None, None):
                raise ValueError(f"{colour} limits nothing; give at least one end")
            if ends is not None and None not in ends and not ends[0] < ends[1]:  # type: ignore[operator]
                raise ValueError(f"{colour} limits contradict each other: {ends[0]:g} is not below {ends[1]:g}")
        if self.yellow is None and self.red is None:
            raise ValueError("give 'yellow', 'red' or both")
        for inner, outer, word in zip(self.yellow or (), self.red or (), ("below", "above"), strict=False):
            if inner is not None and outer is not None and (inner < outer if word == "below" else inner > outer):
                raise ValueError(f"the yellow limit {inner:g} lies {word} the red one {outer:g}; yellow comes first")
        return self


class Channel(Strict):
    """One telemetry column that the twin uses."""

    kind: Literal["temperature", "power", "auxiliary"]
    unit: str | None = None
    noise_std: Magnitude | None = None
    interpolation: Literal["hold", "linear"] | None = None
    levels: StrictBool = False
    limits: Limits | None = None

    @model_validator(mode="after")
    def _unit_fits_kind(self) -> Self:
        allowed = {"temperature": ("K", "degC"), "power": ("W", "percent")}.get(self.kind)
        if allowed and self.unit not in allowed:
            raise ValueError(f"unit of a {self.kind} channel is {' or '.join(allowed)} (got {self.unit!r})")
        if self.levels and self.kind != "auxiliary":
            raise ValueError("only an auxiliary channel has levels")
        if self.noise_std is not None and self.kind != "temperature":
            raise ValueError("noise_std belongs to a temperature channel")
        if self.levels and self.interpolation == "linear":
            raise ValueError("a channel with levels is held, not interpolated")
        return self

    @property
    def is_held(self) -> bool:
        """True where a sample holds until the next one, False where values are interpolated linearly."""
        if self.interpolation is not None:
            return self.interpolation == "hold"
        return self.kind == "power" or self.levels


class Node(Strict):
    """A lumped thermal mass; without a sensor it is a hidden state."""

    id: Name
    sensor: Name | tuple[Name, ...] | None = None
    capacity_J_per_K: HeatCapacity | None = None

    @property
    def sensors(self) -> tuple[str, ...]:
        """The temperature channels that read this node."""
        if self.sensor is None:
            return ()
        return (self.sensor,) if isinstance(self.sensor, str) else self.sensor


class Conductor(Strict):
    """A symmetric linear coupling GL (W/K) between two nodes, or a node and a boundary."""

    between: tuple[Name, Name]
    conductance_W_per_K: Conductance | None = None

    @field_validator("between")
    @classmethod
    def _two_ends(cls, value: tuple[str, str]) -> tuple[str, str]:
        if value[0] == value[1]:
            raise ValueError(f"joins '{value[0]}' to itself")
        return value


class Radiator(Strict):
    """Declared and known radiation: sigma * emissivity * area * (T_sink^4 - T^4) into the node."""

    node: Name
    emissivity: Fraction
    area_m2: Magnitude
    sink: Name


class Table(Strict):
    """Heat as an unknown function of an auxiliary channel: piecewise linear over knots, or one value per level."""

    knots: tuple[Number, ...] | None = None

    @field_validator("knots")
    @classmethod
    def _increasing(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and (len(value) < 2 or any(b <= a for a, b in pairwise(value))):
            raise ValueError("knots must be at least two and strictly increasing")
        return value


class Load(Strict):
    """A declared heat input into one node."""

    channel: Name
    node: Name
    weight: Fraction = 1.0
    gain: Quantity | None = None
    solar: StrictBool = False
    table: Table | None = None


class Interval(Strict):
    """An interval that takes no part in any fit or score."""

    start: str | Number
    stop: str | Number
    reason: str = ""

    @field_validator("start", "stop")
    @classmethod
    def _is_time(cls, value: str | float) -> str | float:
        if isinstance(value, str):
            try:
                parse_instant_ns(value)
            except TelemetryError as error:
                raise ValueError(str(error)) from error
        return value

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if isinstance(self.start, str) != isinstance(self.stop, str):
            raise ValueError("start and stop must both be dates or both be seconds")
        start, stop = (parse_instant_ns(x) if isinstance(x, str) else x for x in (self.start, self.stop))
        if not start < stop:
            raise ValueError("stop must come after start")
        return self


class SensorCriteria(Strict):
    """Correlation acceptance of one sensor; what is left out is that of all."""

    bias_K: Positive | None = None
    std_K: Positive | None = None
    q99_abs_K: Positive | None = None


class Criteria(Strict):
    """Correlation acceptance. The defaults are the usual test-correlation goals: 2 K of bias, 5 K for 99 % of samples.

    The standard deviation of the error is judged where a limit is given; ``per_sensor`` gives some sensors their own limits.
    """

    bias_K: Positive = 2.0
    std_K: Positive | None = None
    q99_abs_K: Positive = 5.0
    per_sensor: dict[Name, SensorCriteria] = Field(default_factory=dict)

    def of(self, sensor: str) -> dict[str, float]:
        """Return the limits of a sensor: bias_K, q99_abs_K, and std_K where there is one."""
        common = self.model_dump(include={"bias_K", "std_K", "q99_abs_K"}, exclude_none=True)
        own = self.per_sensor.get(sensor)
        return common if own is None else common | own.model_dump(exclude_none=True)


class TwinSpec(Strict):
    """The whole specification of a twin (contract section 3)."""

    twin: Annotated[str, Field(pattern=TWIN_ID)]
    boundaries: dict[Name, Boundary] = Field(default_factory=dict)
    channels: dict[Name, Channel]
    nodes: Annotated[tuple[Node, ...], Field(min_length=1)]
    conductors: tuple[Conductor, ...] = ()
    radiators: tuple[Radiator, ...] = ()
    loads: tuple[Load, ...] = ()
    exclude: tuple[Interval, ...] = ()
    criteria: Criteria = Criteria()
    parameters: dict[Name, Quantity] = Field(default_factory=dict)
    orbit: OrbitBlock | None = None

    @model_validator(mode="after")
    def _names_resolve(self) -> Self:
        problems = list(dict.fromkeys(self._problems()))
        if problems:
            raise PydanticCustomError(REFERENCES, "references", {"problems": problems})
        return self

    def _problems(self) -> Iterable[str]:
        """Yield every broken reference; the first becomes the headline."""
        nodes = [node.id for node in self.nodes]
        yield from (f"nodes[{i}].id: '{n}' is declared twice" for i, n in enumerate(nodes) if n in nodes[:i])
        yield from (f"boundaries.{name}: a node has the same id" for name in self.boundaries if name in nodes)
        for name, boundary in self.boundaries.items():
            if boundary.channel is not None:
                yield from self._check_channel(f"boundaries.{name}.channel", boundary.channel, ("temperature",))
        seen: dict[str, str] = {}
        for i, node in enumerate(self.nodes):
            for sensor in node.sensors:
                yield from self._check_channel(f"nodes[{i}].sensor", sensor, ("temperature",))
                if sensor in seen:
                    yield f"nodes[{i}].sensor: '{sensor}' already reads node '{seen[sensor]}'"
                seen[sensor] = node.id
        for name, boundary in self.boundaries.items():
            if boundary.channel in seen:
                yield f"boundaries.{name}.channel: '{boundary.channel}' reads node '{seen[boundary.channel]}'; one of both"
        if not seen:
            yield "nodes: none has a sensor; name the temperature channel of at least one node"
        yield from self._check_conductors(nodes)
        yield from self._check_unseen()
        for i, radiator in enumerate(self.radiators):
            yield from self._check_end(f"radiators[{i}].node", radiator.node, nodes)
            yield from self._check_end(f"radiators[{i}].sink", radiator.sink, list(self.boundaries), "boundary")
            if (radiator.node, radiator.sink) in [(r.node, r.sink) for r in self.radiators[:i]]:
                yield f"radiators[{i}]: '{radiator.node}' radiates to '{radiator.sink}' twice; add the areas"
        yield from self._check_orbit()
        yield from self._check_loads(nodes)
        yield from self._check_shared()
        for sensor in self.criteria.per_sensor:
            if sensor not in seen:
                yield f"criteria.per_sensor.{sensor}: reads no node (sensors: {', '.join(seen) or 'none'})"

    def _check_unseen(self) -> Iterable[str]:
        """Refuse hidden nodes that are joined with one another and with no node that is read: no data tell anything of them.

        A single one may yet be joined by what the closed loop finds; it is told among the doubts.
        """
        groups = {node.id: {node.id} for node in self.nodes}
        for conductor in self.conductors:
            one, other = (groups.get(end) for end in conductor.between)
            if one is not None and other is not None and one is not other:
                one |= other
                groups |= dict.fromkeys(other, one)
        read = {node.id for node in self.nodes if node.sensors}
        for group in {id(group): group for group in groups.values()}.values():
            if len(group) > 1 and not group & read:
                names = ", ".join(sorted(group)[:5]) + (f" and {len(group) - 5} more" if len(group) > 5 else "")
                yield f"nodes: no sensor sees {names}: join one of them to a node with a sensor, or remove them"

    def _check_shared(self) -> Iterable[str]:
        """Check the shared unknowns: each is used, by quantities of one kind, and has a size to start from."""
        used: dict[str, str] = {}
        for field, tie, unit in self.ties:
            if tie[0] not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                yield f"{field}: unknown parameter '{tie[0]}'; declare it under parameters (known: {known})"
            elif used.setdefault(tie[0], unit) != unit:
                yield f"{field}: '{tie[0]}' is in {used[tie[0]]} elsewhere and would be in {unit} here; give it another name"
        for name, quantity in self.parameters.items():
            if ":" in name or "." in name:
                yield f"parameters.{name}: a shared unknown has neither ':' nor '.' in its name"
            if quantity.guess is None and quantity.value is None:
                yield f"parameters.{name}: give a 'guess' that is calibrated, or a 'value' that is held"
            if name not in used:
                yield f"parameters.{name}: is used nowhere; name it as 'per_area' or 'per_mass', or remove it"

    @property
    def ties(self) -> list[tuple[str, tuple[str, float], str]]:
        """Where shared unknowns are used: field, (name, size), and the unit that this makes the unknown's."""
        masses = [
            (f"nodes[{i}].capacity_J_per_K.per_mass", node.capacity_J_per_K.tie, "J/kg/K")
            for i, node in enumerate(self.nodes)
            if node.capacity_J_per_K is not None
        ]
        areas = [
            (f"conductors[{i}].conductance_W_per_K.per_area", conductor.conductance_W_per_K.tie, "W/m2/K")
            for i, conductor in enumerate(self.conductors)
            if conductor.conductance_W_per_K is not None
        ]
        return [(field, tie, unit) for field, tie, unit in [*masses, *areas] if tie is not None]

    def _check_orbit(self) -> Iterable[str]:
        for name in () if self.orbit is None else self.orbit.units:
            if name in self.channels:
                yield f"channels.{name}: comes from the orbit; remove it, or declare no orbit"
        for name in self.attitude_channels:
            yield from self._check_channel("orbit.attitude.quaternion_channels", name, ("auxiliary",))
            if name in self.channels and self.channels[name].levels:
                yield f"orbit.attitude.quaternion_channels: channel '{name}' has levels; a quaternion has none"

    def _check_conductors(self, nodes: list[str]) -> Iterable[str]:
        pairs: set[frozenset[str]] = set()
        for i, conductor in enumerate(self.conductors):
            ends = frozenset(conductor.between)
            for end in conductor.between:
                yield from self._check_end(
                    f"conductors[{i}].between", end, [*nodes, *self.boundaries], "node or boundary"
                )
            if ends <= set(self.boundaries):
                yield f"conductors[{i}].between: joins two boundaries; one end must be a node"
            if ends in pairs:
                yield f"conductors[{i}].between: {' and '.join(conductor.between)} are joined twice; add the conductances"
            pairs.add(ends)

    def _check_loads(self, nodes: list[str]) -> Iterable[str]:
        weights: dict[str, float] = {}
        for i, load in enumerate(self.loads):
            yield from self._check_end(f"loads[{i}].node", load.node, nodes)
            yield from self._check_channel(f"loads[{i}].channel", load.channel, ("power", "auxiliary"))
            if load.solar and load.channel in self.orbit_channels:
                yield f"loads[{i}].solar: '{load.channel}' follows the Sun's distance already; leave it out"
            if (load.channel, load.node) in [(other.channel, other.node) for other in self.loads[:i]]:
                yield f"loads[{i}]: channel '{load.channel}' heats node '{load.node}' twice; add the weights"
            channel = self.inputs.get(load.channel)
            if channel is None or channel.kind == "temperature":
                continue
            if load.table is None and channel.kind == "auxiliary":
                yield f"loads[{i}].table: auxiliary channel '{load.channel}' is not heat; give a table with knots"
            if load.table is not None and channel.kind == "power":
                yield f"loads[{i}].table: '{load.channel}' is heat already; a table explains an auxiliary channel"
            if load.table is not None and load.gain is not None:
                yield f"loads[{i}].gain: a load with a table has no gain; its values are calibrated"
            if load.table is not None and channel.levels is False and load.table.knots is None:
                yield f"loads[{i}].table.knots: missing; '{load.channel}' has no levels"
            if load.table is None and load.gain is None and channel.unit == "W":
                weights[load.channel] = weights.get(load.channel, 0.0) + load.weight
        for name, total in weights.items():
            if total > 1.0 + 1e-9:
                yield f"loads: the weights of channel '{name}' add to {total:g}; they may add to 1 at most"

    def _check_channel(self, field: str, name: str, kinds: tuple[str, ...]) -> Iterable[str]:
        if name not in self.inputs:
            how = "declare it under channels"
            if name.startswith(PREFIX):
                how = "declare the orbit" if self.orbit is None else "correct its name"
            yield f"{field}: unknown channel '{name}'; {how} (known: {', '.join(self.inputs) or 'none'})"
        elif self.inputs[name].kind not in kinds:
            yield f"{field}: channel '{name}' is {self.inputs[name].kind}, must be {' or '.join(kinds)}"

    @staticmethod
    def _check_end(field: str, name: str, known: list[str], what: str = "node") -> Iterable[str]:
        if name not in known:
            yield f"{field}: unknown {what} '{name}' (known: {', '.join(known) or 'none'})"

    @property
    def sensors(self) -> tuple[str, ...]:
        """Every sensor channel, in the order of the nodes."""
        return tuple(sensor for node in self.nodes for sensor in node.sensors)

    @cached_property
    def orbit_channels(self) -> Mapping[str, Channel]:
        """What the orbit gives wherever the telemetry is dated: heat per area as power in W/m2, the others auxiliary."""
        units = {} if self.orbit is None else self.orbit.units
        return {
            name: Channel.model_construct(
                kind="power" if unit == "W/m2" else "auxiliary", unit=unit, interpolation="linear"
            )
            for name, unit in units.items()
        }

    @cached_property
    def inputs(self) -> Mapping[str, Channel]:
        """Every channel by its name: those of the telemetry, and those of the orbit."""
        return {**self.channels, **self.orbit_channels}

    @property
    def attitude_channels(self) -> tuple[str, ...]:
        """The telemetry that tells the attitude: four parts of a quaternion, scalar first, or none."""
        told = None if self.orbit is None else self.orbit.attitude.quaternion_channels
        return told or ()

    @property
    def used_channels(self) -> tuple[str, ...]:
        """Every channel that a node, boundary or load uses, and every auxiliary channel that may explain heat."""
        used = set(self.sensors) | {load.channel for load in self.loads}
        used |= {b.channel for b in self.boundaries.values() if b.channel is not None}
        used |= {name for name, channel in self.channels.items() if channel.kind != "temperature"}
        return tuple(name for name in self.channels if name in used)

    @property
    def driving_channels(self) -> frozenset[str]:
        """The used channels that no sensor reads: inputs and boundary temperatures."""
        return frozenset(self.used_channels) - frozenset(self.sensors)

    def noise_std_K(self, sensor: str) -> float | None:
        """The declared noise of a sensor in kelvin (a difference: the same number in degC)."""
        return self.channels[sensor].noise_std
