"""The scenario file: a cross-section, what drives it, what is measured, and what is hidden."""

from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self, get_args

from pydantic import Field, ValidationError, model_validator

from twin_core.errors import SpecError
from twin_core.fem.geometry import SIDES, Grid, bodies, lay_grid
from twin_core.fem.hidden import AnyHiddenEffect, HiddenEffect
from twin_core.fem.materials import MATERIALS, Material
from twin_core.fem.parts import (
    Boundary,
    Coupling,
    Forcing,
    Joint,
    Load,
    MaterialField,
    Part,
    Radiator,
    Region,
    Sensor,
    Strap,
    Times,
)
from twin_core.fem.signals import AnySignal
from twin_core.fem.thermostat import Thermostat
from twin_core.network.quantities import Name, Positive, Temperature
from twin_core.network.spec import Channel
from twin_core.network.spec_io import read_model
from twin_core.units import parse_instant_ns

MOST_CELLS = 250_000
_TAGS = {
    tag
    for union, field in ((AnyHiddenEffect, "effect"), (AnySignal, "signal"))
    for member in get_args(get_args(union)[0])
    for tag in get_args(member.model_fields[field].annotation)
}


class Scenario(Part):
    """A whole scenario: geometry, materials, forcings, sensors, hidden effects."""

    scenario: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,62}$")]
    seed: Annotated[int, Field(ge=0)] = 0
    depth_m: Positive = 1.0
    mesh_size_m: Positive
    initial_K: Temperature = 293.15
    time: Times
    materials: dict[str, MaterialField] = Field(default_factory=dict)
    regions: Annotated[tuple[Region, ...], Field(min_length=1)]
    joints: tuple[Joint, ...] = ()
    straps: tuple[Strap, ...] = ()
    boundaries: dict[Name, Boundary] = Field(default_factory=dict)
    radiators: tuple[Radiator, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    forcings: dict[Name, Forcing] = Field(default_factory=dict)
    loads: tuple[Load, ...] = ()
    thermostats: tuple[Thermostat, ...] = ()
    sensors: Annotated[tuple[Sensor, ...], Field(min_length=1)]
    hidden: tuple[AnyHiddenEffect, ...] = ()

    @model_validator(mode="after")
    def _names_resolve(self) -> Self:
        for problem in self._problems():
            raise ValueError(problem)
        try:
            bodies(self.grid, [joint.between for joint in self.joints])
        except SpecError as error:
            raise ValueError(str(error)) from error
        return self

    @cached_property
    def grid(self) -> Grid:
        """The cells of the cross-section."""
        return lay_grid({region.id: (region.x_m, region.y_m) for region in self.regions}, self.mesh_size_m)

    @property
    def channels(self) -> Mapping[str, Channel]:
        """Every recorded channel as a telemetry writer knows it."""
        sensors = {
            sensor.channel: Channel(kind="temperature", unit=sensor.unit, noise_std=sensor.noise_std_K or None)
            for sensor in self.sensors
        }
        recorded = {name: forcing.channel for name, forcing in self.forcings.items() if forcing.recorded}
        return sensors | recorded | {thermostat.channel: thermostat.telemetry for thermostat in self.thermostats}

    @property
    def epoch_ns(self) -> int | None:
        """Unix nanoseconds of the first sample, None without dates."""
        return None if self.time.start is None else parse_instant_ns(self.time.start)

    def material(self, region: Region) -> Material:
        """Return the material of a region; the scenario's own come before the built-in ones."""
        if region.material in self.materials:
            return Material(**self.materials[region.material].model_dump())
        return MATERIALS[region.material]

    def pairs_joined(self) -> set[frozenset[str]]:
        """Return the pairs of regions with a joint or a strap."""
        straps = (tuple(place.partition(".")[0] for place in strap.between) for strap in self.straps)
        return {frozenset(pair) for pair in (*(joint.between for joint in self.joints), *straps)}

    def radiating_pairs(self) -> set[tuple[str, str]]:
        """Return (region, sink) of every radiator on a region's own surface."""
        return {(radiator.surface.partition(".")[0], radiator.sink) for radiator in self.radiators}

    def kind_of(self, channel: str) -> str:
        """Return the kind of a forcing."""
        return self.forcings[channel].kind

    def levels_of(self, channel: str) -> bool:
        """Return whether a forcing has levels."""
        return self.forcings[channel].levels

    def _problems(self) -> Iterable[str]:
        """Yield every broken reference; the first becomes the message."""
        ids = [region.id for region in self.regions]
        yield from (f"regions[{i}].id: '{n}' is declared twice" for i, n in enumerate(ids) if n in ids[:i])
        yield from (f"regions[{i}].id: '{n}' is the name of an outer edge" for i, n in enumerate(ids) if n in SIDES)
        for i, region in enumerate(self.regions):
            known = [*self.materials, *MATERIALS]
            yield from _unknown(f"regions[{i}].material", region.material, known, "material")
        yield from self._size_problem()
        yield from self._network_problems(ids)
        yield from self._channel_problems(ids)
        for i, effect in enumerate(self.hidden):
            yield from (f"hidden[{i}]: {problem}" for problem in self._effect_problems(effect, ids))

    def _size_problem(self) -> Iterable[str]:
        """Yield a mesh that would be endless, before it is made."""
        x_m = [edge for region in self.regions for edge in region.x_m]
        y_m = [edge for region in self.regions for edge in region.y_m]
        cells = (max(x_m) - min(x_m)) * (max(y_m) - min(y_m)) / self.mesh_size_m**2
        if cells > MOST_CELLS:
            yield f"mesh_size_m: {cells:.3g} cells of {self.mesh_size_m:g} m; raise it ({MOST_CELLS} cells at most)"

    def _network_problems(self, ids: list[str]) -> Iterable[str]:
        pairs: list[frozenset[str]] = []
        for i, joint in enumerate(self.joints):
            for end in joint.between:
                yield from _unknown(f"joints[{i}].between", end, ids, "region")
            pair = frozenset(joint.between)
            if len(pair) == 1 or pair in pairs:
                yield f"joints[{i}].between: {' and '.join(joint.between)} are joined already"
            pairs.append(pair)
        for i, strap in enumerate(self.straps):
            for end in strap.between:
                yield from self._place_problem(f"straps[{i}].between", end, ids)
        for i, radiator in enumerate(self.radiators):
            if radiator.surface in ids:
                yield f"radiators[{i}].surface: '{radiator.surface}' is a region; name a side such as {radiator.surface}.left"
            yield from self._place_problem(f"radiators[{i}].surface", radiator.surface, ids)
            yield from _unknown(f"radiators[{i}].sink", radiator.sink, list(self.boundaries), "boundary")
        for i, coupling in enumerate(self.couplings):
            yield from self._place_problem(f"couplings[{i}].place", coupling.place, ids)
            yield from _unknown(f"couplings[{i}].boundary", coupling.boundary, list(self.boundaries), "boundary")

    def _channel_problems(self, ids: list[str]) -> Iterable[str]:
        forcings = list(self.forcings)
        for name, boundary in self.boundaries.items():
            if boundary.forcing is not None:
                yield from self._forcing_problem(f"boundaries.{name}.forcing", boundary.forcing, "temperature")
        for name, forcing in self.forcings.items():
            if forcing.signal.needs_date and self.time.start is None:
                yield f"forcings.{name}.signal: an orbit needs a date; give time.start"
        for i, load in enumerate(self.loads):
            yield from self._forcing_problem(f"loads[{i}].forcing", load.forcing, "power")
            yield from self._place_problem(f"loads[{i}].place", load.place, ids)
        names = [sensor.channel for sensor in self.sensors]
        switched = [thermostat.channel for thermostat in self.thermostats]
        for i, thermostat in enumerate(self.thermostats):
            yield from _unknown(f"thermostats[{i}].region", thermostat.region, ids, "region")
            if thermostat.channel in (*names, *forcings, *switched[:i]):
                yield f"thermostats[{i}].channel: '{thermostat.channel}' is declared twice"
        for i, sensor in enumerate(self.sensors):
            if sensor.channel in names[:i] or sensor.channel in forcings:
                yield f"sensors[{i}].channel: '{sensor.channel}' is declared twice"
            if sensor.region is not None:
                yield from _unknown(f"sensors[{i}].region", sensor.region, ids, "region")
            if sensor.at_m is not None and not self._holds(sensor.at_m):
                yield f"sensors[{i}].at_m: ({sensor.at_m[0]:g}, {sensor.at_m[1]:g}) lies in no region"
        for i, gap in enumerate(self.time.gaps):
            if gap.channel is not None:
                yield from _unknown(f"time.gaps[{i}].channel", gap.channel, list(self.channels), "channel")
            if not gap.start_s < gap.stop_s:
                yield f"time.gaps[{i}]: stop_s must come after start_s"

    def _effect_problems(self, effect: HiddenEffect, ids: list[str]) -> Iterable[str]:
        known = {
            "node": (ids, "region"),
            "nodes": (ids, "region"),
            "sink": (list(self.boundaries), "boundary"),
            "boundary": (list(self.boundaries), "boundary"),
            "sensor": ([sensor.channel for sensor in self.sensors], "sensor"),
        }
        for key, value in effect.where.items():
            if key == "channel":
                yield from self._forcing_problem(key, value, effect.channel_kind)
            else:
                for name in value if isinstance(value, list) else [value]:
                    yield from _unknown(key, name, *known[key])
        if isinstance(getattr(effect, "time", None), str) and self.time.start is None:
            yield "time: is a date, but the scenario counts seconds; give time.start or a number"
        yield from effect.problems(self)

    def _forcing_problem(self, field: str, name: str, kind: str) -> Iterable[str]:
        if name not in self.forcings:
            yield from _unknown(field, name, list(self.forcings), "forcing")
        elif self.forcings[name].kind != kind:
            yield f"{field}: forcing '{name}' is {self.forcings[name].kind}, must be {kind}"

    def _place_problem(self, field: str, place: str, ids: list[str]) -> Iterable[str]:
        """Yield what is wrong with a place: a region, ``region.side``, or an outer edge such as ``left``."""
        region, dot, side = place.partition(".")
        if place in SIDES or (place in ids and not dot):
            return
        yield from _unknown(field, region, [*ids, *SIDES], "region or outer edge")
        if side not in (*SIDES, "all"):
            yield f"{field}: unknown side '{side}' of '{region}' (known: {', '.join(SIDES)}, all)"
        elif side != "all" and not self.grid.has_free_side(region, side):
            yield f"{field}: '{region}' has no free side facing {side}"

    def _holds(self, point_m: tuple[float, float]) -> bool:
        return any(
            region.x_m[0] <= point_m[0] <= region.x_m[1] and region.y_m[0] <= point_m[1] <= region.y_m[1]
            for region in self.regions
        )


def _unknown(field: str, name: str, known: list[str], what: str) -> Iterable[str]:
    if name not in known:
        yield f"{field}: unknown {what} '{name}' (known: {', '.join(known) or 'none'})"


def _in_words(error: ValidationError) -> list[str]:
    """Return every problem as ``field: what is wrong``, missing fields last."""
    items = sorted(error.errors(), key=lambda item: item["type"] == "missing")
    return list(dict.fromkeys(_one_line(item) for item in items))


def _one_line(first: Mapping[str, Any]) -> str:
    """Return one problem as ``field: what is wrong``; the tags of signals and effects are no fields."""
    where = ""
    for previous, part in zip((None, *first["loc"]), first["loc"], strict=False):
        if isinstance(part, int):
            where += f"[{part}]"
        elif not (part in _TAGS and (previous == "signal" or isinstance(previous, int))):
            where += f"{'.' if where else ''}{part}"
    fixed = {"extra_forbidden": "unknown field; remove it or correct its spelling", "missing": "is missing"}
    message = fixed.get(first["type"], first["msg"].removeprefix("Value error, "))
    if first["type"] not in (*fixed, "value_error") and not isinstance(first["input"], dict | list | tuple):
        message += f" (got {first['input']!r})"
    return f"{where}: {message}" if where else message


def load_scenario(source: Path | str | dict[str, Any]) -> Scenario:
    """Return the validated scenario from a YAML or JSON file, or from its parsed mapping; SpecError as ``read_model``."""
    return read_model(source, Scenario, _in_words)


__all__ = ["Scenario", "load_scenario"]
