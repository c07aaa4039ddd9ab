"""Signals over time that drive a scenario: one small class each, a function of time once a seed is given."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from twin_core._typing import FloatArray
from twin_core.constants import EARTH_RADIUS_M
from twin_core.errors import TelemetryError
from twin_core.network.quantities import Fraction, Number, Positive
from twin_core.units import parse_instant_ns

Path = Callable[[FloatArray], FloatArray]
"""A realised signal: times in seconds (any shape) to values."""


@dataclass(frozen=True)
class Span:
    """What a signal needs to become a function of time: from, to, dice, and the instant of time 0 if there is one."""

    start_s: float
    stop_s: float
    rng: np.random.Generator
    epoch_ns: int | None = None


class Signal(BaseModel):
    """What a forcing channel does over time."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    needs_date: ClassVar[bool] = False

    @abstractmethod
    def realise(self, span: Span) -> Path:
        """Return the signal as a function of time, valid over the span."""


class Constant(Signal):
    """The same value always."""

    signal: Literal["constant"]
    value: Number

    def realise(self, span: Span) -> Path:
        """Return the constant."""
        return lambda time_s: np.full(np.shape(time_s), self.value)


class Sine(Signal):
    """mean + amplitude sin(2 pi t / period + phase)."""

    signal: Literal["sine"]
    mean: Number = 0.0
    amplitude: Number
    period_s: Positive
    phase_deg: Number = 0.0

    def realise(self, span: Span) -> Path:
        """Return the sine."""
        phase = np.radians(self.phase_deg)
        return lambda time_s: self.mean + self.amplitude * np.sin(2.0 * np.pi * time_s / self.period_s + phase)


class Sun(Signal):
    """Half-rectified sun on one face with an eclipse: peak max(0, cos(u - phase)), zero in the shadow.

    The orbit angle is u = 2 pi t / period; the shadow of ``eclipse_deg`` is centred at ``eclipse_centre_deg``.
    """

    signal: Literal["sun"]
    peak: Number
    period_s: Positive
    phase_deg: Number = 0.0
    eclipse_deg: Annotated[Number, Field(ge=0, lt=360)] = 0.0
    eclipse_centre_deg: Number = 180.0

    def realise(self, span: Span) -> Path:
        """Return the absorbed heat over time."""

        def path(time_s: FloatArray) -> FloatArray:
            angle_deg = 360.0 * np.asarray(time_s) / self.period_s
            cosine = np.cos(np.radians(angle_deg - self.phase_deg))
            from_shadow_deg = np.abs((angle_deg - self.eclipse_centre_deg + 180.0) % 360.0 - 180.0)
            return np.where(from_shadow_deg < self.eclipse_deg / 2.0, 0.0, self.peak * np.maximum(cosine, 0.0))

        return path


class Telegraph(Signal):
    """Switching between levels at random instants; the time at a level is exponential with mean ``dwell_s``."""

    signal: Literal["telegraph"]
    levels: Annotated[tuple[Number, ...], Field(min_length=2)]
    dwell_s: Positive

    def realise(self, span: Span) -> Path:
        """Draw the instants and the levels; each switch goes to another level, equally likely."""
        rng = span.rng
        instants, chosen = [span.start_s], [int(rng.integers(len(self.levels)))]
        while instants[-1] < span.stop_s:
            instants.append(instants[-1] + float(rng.exponential(self.dwell_s)))
            step = int(rng.integers(1, len(self.levels)))
            chosen.append((chosen[-1] + step) % len(self.levels))
        edges, values = np.array(instants), np.array(self.levels)[chosen]
        return lambda time_s: values[np.maximum(np.searchsorted(edges, time_s, side="right") - 1, 0)]


class Slew(Signal):
    """An angle that rests at random values in ``between`` and slews to the next at a fixed rate."""

    signal: Literal["slew"]
    between: tuple[Number, Number]
    dwell_s: Positive
    rate_per_s: Positive

    def realise(self, span: Span) -> Path:
        """Draw rests and targets and join them by straight lines."""
        rng = span.rng
        times, values = [span.start_s], [float(rng.uniform(*self.between))]
        while times[-1] < span.stop_s:
            target = float(rng.uniform(*self.between))
            leave = times[-1] + float(rng.exponential(self.dwell_s)) + 1e-3
            times += [leave, leave + abs(target - values[-1]) / self.rate_per_s]
            values += [values[-1], target]
        return lambda time_s: np.interp(time_s, times, values)


class GaussianProcess(Signal):
    """A smooth random signal, covariance std^2 exp(-tau^2 / (2 length^2)), cut off below ``minimum``."""

    signal: Literal["gaussian_process"]
    mean: Number
    std: Positive
    correlation_length_s: Positive
    minimum: Number | None = None

    def realise(self, span: Span) -> Path:
        """Draw white noise on a grid of a tenth of the length, smooth it, and join by a cubic spline.

        White noise smoothed with a Gaussian of width length / sqrt(2) has exactly this covariance.
        """
        from scipy.interpolate import CubicSpline
        from scipy.signal import fftconvolve

        length = self.correlation_length_s
        grid = np.arange(span.start_s - length, span.stop_s + 2.0 * length, length / 10.0)
        lag = np.arange(-60, 61) * (length / 10.0)
        kernel = np.exp(-((lag / length) ** 2))
        noise = span.rng.standard_normal(grid.size + kernel.size - 1)
        smooth = fftconvolve(noise, kernel, mode="valid") / np.sqrt(np.sum(kernel**2))
        spline = CubicSpline(grid, self.mean + self.std * smooth)
        floor = -np.inf if self.minimum is None else self.minimum
        return lambda time_s: np.maximum(spline(time_s), floor)


class Table(Signal):
    """Given values at given times, joined by straight lines or held; constant beyond both ends."""

    signal: Literal["table"]
    time_s: Annotated[tuple[Number, ...], Field(min_length=1)]
    values: tuple[Number, ...]
    held: bool = False

    @model_validator(mode="after")
    def _columns_match(self) -> Self:
        if len(self.time_s) != len(self.values):
            raise ValueError(f"time_s has {len(self.time_s)} entries, values has {len(self.values)}")
        if any(b <= a for a, b in zip(self.time_s, self.time_s[1:], strict=False)):
            raise ValueError("time_s must strictly increase")
        return self

    def realise(self, span: Span) -> Path:
        """Return the interpolant."""
        times, values = np.array(self.time_s), np.array(self.values)
        if self.held:
            return lambda time_s: values[np.maximum(np.searchsorted(times, time_s, side="right") - 1, 0)]
        return lambda time_s: np.interp(time_s, times, values)


class Elements(BaseModel):
    """Keplerian elements and the instant at which they hold."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    epoch: str
    semi_major_axis_m: Annotated[Number, Field(gt=EARTH_RADIUS_M)]
    eccentricity: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    inclination_deg: Number
    node_deg: Number = 0.0
    perigee_deg: Number = 0.0
    mean_anomaly_deg: Number = 0.0

    @field_validator("epoch")
    @classmethod
    def _is_instant(cls, value: str) -> str:
        try:
            parse_instant_ns(value)
        except TelemetryError as error:
            raise ValueError(str(error)) from error
        return value


class OrbitFace(Signal):
    """Heat absorbed by a flat face in a real orbit: area (alpha (solar + albedo) + epsilon infrared)."""

    signal: Literal["orbit_face"]
    needs_date: ClassVar[bool] = True
    elements: Elements | None = None
    tle: tuple[str, str] | None = None
    attitude: Literal["inertial", "nadir", "sun"] = "nadir"
    normal: tuple[Number, Number, Number]
    area_m2: Positive
    absorptance: Fraction
    emissivity: Fraction

    @model_validator(mode="after")
    def _one_orbit(self) -> Self:
        if (self.elements is None) == (self.tle is None):
            raise ValueError("give exactly one of 'elements', 'tle'")
        if not any(self.normal):
            raise ValueError("normal must not be (0, 0, 0)")
        return self

    def realise(self, span: Span) -> Path:
        """Return the absorbed heat over time."""
        from twin_core.orbit.environment import face_heat
        from twin_core.orbit.path import KeplerOrbit, Orbit
        from twin_core.orbit.tle import TleOrbit

        orbit: Orbit
        if self.elements is not None:
            numbers = self.elements.model_dump(exclude={"epoch"})
            orbit = KeplerOrbit(**numbers, epoch_ns=parse_instant_ns(self.elements.epoch))
        else:
            orbit = TleOrbit(*self.tle)  # type: ignore[misc]  # validated: one of the two is there
        epoch_ns, frame = span.epoch_ns or 0, {"nadir": "orbit"}.get(self.attitude, self.attitude)

        def path(time_s: FloatArray) -> FloatArray:
            heat = face_heat(orbit, frame, self.normal, epoch_ns, np.ravel(time_s))
            absorbed = self.absorptance * (heat.solar + heat.albedo) + self.emissivity * heat.infrared
            return self.area_m2 * absorbed.reshape(np.shape(time_s))

        return path


AnySignal = Annotated[
    Constant | Sine | Sun | Telegraph | Slew | GaussianProcess | Table | OrbitFace,
    Field(discriminator="signal"),
]
"""The registry of signals: adding one is one class above and one name here."""
