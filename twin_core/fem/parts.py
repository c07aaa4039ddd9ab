"""The parts of a scenario file, each checked on its own: regions, joints, forcings, sensors, times."""

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from twin_core.errors import TelemetryError
from twin_core.fem.signals import AnySignal
from twin_core.network.quantities import Fraction, Name, Number, Positive, Temperature
from twin_core.network.spec import Channel
from twin_core.units import parse_instant_ns

NotNegative = Annotated[Number, Field(ge=0)]
Span = tuple[Number, Number]


class Part(BaseModel):
    """A frozen record that knows its fields and refuses others."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class MaterialField(Part):
    """A material of one's own."""

    conductivity_W_per_m_K: Positive
    density_kg_per_m3: Positive
    specific_heat_J_per_kg_K: Positive


class Region(Part):
    """A rectangle of one material; where regions overlap the later one wins."""

    id: Name
    x_m: Span
    y_m: Span
    material: str
    initial_K: Temperature | None = None

    @field_validator("x_m", "y_m")
    @classmethod
    def _has_extent(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not value[0] < value[1]:
            raise ValueError(f"{value[0]:g} is not below {value[1]:g}")
        return value

    @property
    def area_m2(self) -> float:
        """Area of the rectangle."""
        return (self.x_m[1] - self.x_m[0]) * (self.y_m[1] - self.y_m[0])


class Joint(Part):
    """A contact over all sides that two regions have in common; 0 is a perfect insulation."""

    between: tuple[Name, Name]
    conductance_W_per_m2_K: NotNegative


class Strap(Part):
    """A conductance between the means of two places (regions or surfaces)."""

    between: tuple[str, str]
    conductance_W_per_K: Positive


class Boundary(Part):
    """A given temperature: constant, or following a temperature forcing."""

    value_K: Temperature | None = None
    forcing: Name | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.value_K is None) == (self.forcing is None):
            raise ValueError("give exactly one of 'value_K', 'forcing'")
        return self


class Radiator(Part):
    """A surface that radiates by T^4 to a boundary."""

    surface: str
    emissivity: Fraction
    sink: Name


class Coupling(Part):
    """A conductance from a place to a boundary, spread evenly over the place."""

    place: str
    boundary: Name
    conductance_W_per_K: Positive


class Load(Part):
    """Heat of a forcing, spread evenly over a region (volumetric) or a surface (flux)."""

    forcing: Name
    place: str
    weight: Number = 1.0


class Sensor(Part):
    """A temperature channel: reads a point, or the mean of a region."""

    channel: Name
    region: Name | None = None
    at_m: tuple[Number, Number] | None = None
    unit: Literal["K", "degC"] = "K"
    noise_std_K: NotNegative = 0.0
    quantum_K: NotNegative = 0.0

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.region is None) == (self.at_m is None):
            raise ValueError("give exactly one of 'region' (its mean), 'at_m' (a point)")
        return self


class Forcing(Part):
    """A channel that drives the field. With ``hold`` the samples are what is delivered, each until the next."""

    kind: Literal["power", "temperature", "auxiliary"]
    unit: str | None = None
    interpolation: Literal["hold", "linear"] | None = None
    levels: bool = False
    noise_std_K: NotNegative = 0.0
    recorded: bool = True
    signal: AnySignal

    @model_validator(mode="after")
    def _is_a_channel(self) -> Self:
        if self.unit == "percent":
            raise ValueError("unit percent is not heat; declare the forcing in W")
        if self.noise_std_K and self.kind != "temperature":
            raise ValueError("noise_std_K belongs to a temperature forcing")
        Channel(kind=self.kind, unit=self.unit, interpolation=self.interpolation, levels=self.levels)
        return self

    @property
    def is_held(self) -> bool:
        """True where a sample holds until the next one."""
        return self.channel.is_held

    @property
    def channel(self) -> Channel:
        """The channel as a telemetry writer knows it."""
        return Channel(
            kind=self.kind,
            unit=self.unit,
            interpolation=self.interpolation,
            levels=self.levels,
            noise_std=self.noise_std_K or None,
        )


class Gap(Part):
    """An interval without samples, of one channel or of all."""

    start_s: Number
    stop_s: Number
    channel: Name | None = None


class Times(Part):
    """When and how often: the record runs from 0 to ``duration_s``; ``settle_s`` runs before it, unrecorded."""

    duration_s: Positive
    step_s: Positive
    sample_s: Positive
    settle_s: NotNegative = 0.0
    start: str | None = None
    jitter_s: NotNegative = 0.0
    missing_fraction: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    gaps: tuple[Gap, ...] = ()
    scheme: Literal["sdirk2", "imex"] = "sdirk2"

    @field_validator("start")
    @classmethod
    def _is_instant(cls, value: str | None) -> str | None:
        if value is not None:
            try:
                parse_instant_ns(value)
            except TelemetryError as error:
                raise ValueError(str(error)) from error
        return value

    @model_validator(mode="after")
    def _grids_fit(self) -> Self:
        ratio = self.sample_s / self.step_s
        if abs(ratio - round(ratio)) > 1e-9 or ratio < 1:
            raise ValueError(f"step_s ({self.step_s:g}) must divide sample_s ({self.sample_s:g}) evenly")
        if self.duration_s < self.sample_s:
            raise ValueError("duration_s must hold at least one sample interval")
        if self.duration_s / self.step_s > 5e6:
            raise ValueError("more than five million steps; raise step_s")
        if self.jitter_s >= self.sample_s / 2:
            raise ValueError("jitter_s must stay below half of sample_s")
        return self
