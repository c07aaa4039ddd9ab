"""The twin specification: what the operator declares, and whether it fits together."""

from collections.abc import Mapping
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, StrictBool, field_validator, model_validator
from pydantic_core import PydanticCustomError

from twin_core.errors import TelemetryError
from twin_core.network.formula import channels_of, parse
from twin_core.network.orbit_block import OrbitBlock
from twin_core.network.quantities import (
    TWIN_ID,
    Conductance,
    ExchangeArea,
    Fraction,
    HeatCapacity,
    Magnitude,
    Name,
    Number,
    Positive,
    Quantity,
    Strict,
    Temperature,
    Tied,
)
from twin_core.network.references import broken_references
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


def _two_ends(value: tuple[str, str]) -> tuple[str, str]:
    if value[0] == value[1]:
        raise ValueError(f"joins '{value[0]}' to itself")
    return value


Ends2 = Annotated[tuple[Name, Name], AfterValidator(_two_ends)]


class Conductor(Strict):
    """A linear coupling GL (W/K) between two nodes, or a node and a boundary.

    Symmetric; one with ``into`` heats or cools that end alone, as a flow does (GF) or a model that ignores what flows back.
    """

    between: Ends2
    conductance_W_per_K: Conductance | None = None
    into: Name | None = None

    @model_validator(mode="after")
    def _into_an_end(self) -> Self:
        if self.into is not None and self.into not in self.between:
            raise ValueError(f"into must be one of {' and '.join(self.between)} (got '{self.into}')")
        return self

    @property
    def name(self) -> str:
        """Its parameter's name: ``G:a|b``; ``G:b>a`` where only ``a`` feels it."""
        if self.into is None:
            return f"G:{self.between[0]}|{self.between[1]}"
        return f"G:{next(end for end in self.between if end != self.into)}>{self.into}"


class Radiator(Strict):
    """Declared and known radiation: sigma * emissivity * area * (T_sink^4 - T^4) into the node."""

    node: Name
    emissivity: Fraction
    area_m2: Magnitude
    sink: Name


class Radiation(Strict):
    """A radiative coupling GR between two nodes, or a node and a boundary: sigma * R * (T_b^4 - T_a^4) into a, R in m2.

    R is the area times the emissivity, or the factor that a ray tracer gives (Gebhart); unlike that of a radiator it may
    be calibrated.
    """

    between: Ends2
    area_m2: ExchangeArea

    @property
    def name(self) -> str:
        """Its parameter's name, ``R:a|b``."""
        return f"R:{self.between[0]}|{self.between[1]}"


class Thermostat(Strict):
    """On below one temperature, off above another, in between as it was."""

    on_K: Temperature
    off_K: Temperature
    power_W: Quantity

    @model_validator(mode="after")
    def _band(self) -> Self:
        if not self.on_K < self.off_K:
            raise ValueError(f"on_K must lie below off_K ({self.on_K:g} and {self.off_K:g} given)")
        return self


class Proportional(Strict):
    """Heat in proportion to how far the temperature is below a set-point, up to a power where one is given."""

    set_K: Temperature
    gain_W_per_K: Quantity
    most_W: Quantity | None = None


class Heater(Strict):
    """A heater that a temperature controls: that of its own node unless ``control`` names another one."""

    node: Name
    control: Name | None = None
    thermostat: Thermostat | None = None
    proportional: Proportional | None = None

    @model_validator(mode="after")
    def _one_law(self) -> Self:
        if (self.thermostat is None) == (self.proportional is None):
            raise ValueError("give exactly one of 'thermostat' and 'proportional'")
        return self

    @property
    def controlled_by(self) -> str:
        """The node whose temperature switches it."""
        return self.control or self.node

    @property
    def name(self) -> str:
        """What prefixes its parameters' names."""
        return f"heater:{self.node}" if self.control is None else f"heater:{self.node}<{self.control}"


class Derived(Strict):
    """A channel that is computed from others and from the date; heat in W where it says so, else auxiliary."""

    formula: str
    unit: Literal["W"] | None = None
    levels: StrictBool = False

    @field_validator("formula")
    @classmethod
    def _parses(cls, value: str) -> str:
        parse(value)
        return value

    @model_validator(mode="after")
    def _levels_of_no_power(self) -> Self:
        if self.levels and self.unit is not None:
            raise ValueError("only an auxiliary channel has levels")
        return self


class Table(Strict):
    """Heat as a function of an auxiliary channel: piecewise linear over knots, or one value per level.

    Unknown unless its values at the knots are given: known (``values_W``), or guessed with one standard deviation.
    """

    knots: tuple[Number, ...] | None = None
    values_W: tuple[Number, ...] | None = None
    guess_W: tuple[Number, ...] | None = None
    spread_W: Positive | None = None

    @model_validator(mode="after")
    def _one_value_per_knot(self) -> Self:
        if self.values_W is not None and self.guess_W is not None:
            raise ValueError("give either 'values_W' (known, held) or 'guess_W' (calibrated), not both")
        if self.spread_W is not None and self.guess_W is None:
            raise ValueError("spread_W says by how many W a guess may be off; give 'guess_W' with it")
        given = self.values_W or self.guess_W
        if given is not None and len(given) != len(self.knots or ()):
            raise ValueError(f"{len(given)} values for {len(self.knots or ())} knots; give one for each")
        return self

    @field_validator("knots")
    @classmethod
    def _increasing(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and (len(value) < 2 or any(b <= a for a, b in pairwise(value))):
            raise ValueError("knots must be at least two and strictly increasing")
        return value


class Load(Strict):
    """A declared heat input into one node, times an auxiliary channel where ``factor`` names one."""

    channel: Name
    node: Name
    weight: Fraction = 1.0
    gain: Quantity | None = None
    solar: StrictBool = False
    table: Table | None = None
    factor: Name | None = None


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
    radiation: tuple[Radiation, ...] = ()
    heaters: tuple[Heater, ...] = ()
    derived: dict[Name, Derived] = Field(default_factory=dict)
    family: Name | None = None
    """What spacecraft of one design share: they know each other by it."""

    def __repr__(self) -> str:
        """Tell what it declares in one line."""
        couplings = len(self.conductors) + len(self.radiators) + len(self.radiation)
        sensors = ", ".join(self.sensors[:5]) + (", ..." if len(self.sensors) > 5 else "")
        return f"<TwinSpec {self.twin}: {len(self.nodes)} nodes, {couplings} couplings, sensors {sensors}>"

    @model_validator(mode="after")
    def _names_resolve(self) -> Self:
        problems = list(dict.fromkeys(broken_references(self)))
        if problems:
            raise PydanticCustomError(REFERENCES, "references", {"problems": problems})
        return self

    @property
    def ties(self) -> list[tuple[str, tuple[str, float], str]]:
        """Where shared unknowns are used: field, (name, size), and the unit that this makes the unknown's."""
        where: list[tuple[str, Tied | None]] = [
            *((f"nodes[{i}].capacity_J_per_K.", n.capacity_J_per_K) for i, n in enumerate(self.nodes)),
            *((f"conductors[{i}].conductance_W_per_K.", c.conductance_W_per_K) for i, c in enumerate(self.conductors)),
            *((f"radiation[{i}].area_m2.", r.area_m2) for i, r in enumerate(self.radiation)),
        ]
        return [
            (field + tied.tied_by, tied.tie, tied.unit)
            for field, tied in where
            if tied is not None and tied.tie is not None
        ]

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
        """Every channel by its name: those of the telemetry, of the orbit, and those that are computed from them."""
        return {**self.channels, **self.orbit_channels, **self.derived_channels}

    @cached_property
    def derived_channels(self) -> Mapping[str, Channel]:
        """What formulas give, interpolated between the ends of a step; levels and what follows held channels jump there."""
        return {
            name: Channel.model_construct(
                kind="power" if d.unit == "W" else "auxiliary", unit=d.unit, levels=d.levels, interpolation="linear"
            )
            for name, d in self.derived.items()
        }

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

    @property
    def balance_channels(self) -> frozenset[str]:
        """The driving channels that the declared balance reads; of the others each may explain heat that it lacks."""
        read = {name for load in self.loads for name in (load.channel, load.factor) if name is not None}
        read |= {b.channel for b in self.boundaries.values() if b.channel is not None}
        read |= {name for derived in self.derived.values() for name in channels_of(derived.formula)}
        return self.driving_channels & (read | set(self.attitude_channels))

    @property
    def held_inputs(self) -> frozenset[str]:
        """The driving channels whose values hold from sample to sample."""
        return frozenset(name for name in self.driving_channels if self.channels[name].is_held)

    def noise_std_K(self, sensor: str) -> float | None:
        """The declared noise of a sensor in kelvin (a difference: the same number in degC)."""
        return self.channels[sensor].noise_std
