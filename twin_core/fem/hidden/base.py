"""What a hidden effect is: declared in a scenario, felt by the field, never told to the telemetry."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from pydantic import BaseModel, ConfigDict

from twin_core._typing import FloatArray
from twin_core.network.quantities import Number
from twin_core.units import parse_instant_ns

WHERE_KEYS = ("node", "nodes", "sink", "boundary", "channel", "sensor")
"""Fields that say where an effect acts; all others are its parameters."""

Instant = str | Number
"""A time: RFC 3339 in a dated scenario, else seconds from the first sample."""


class Plant(Protocol):
    """What an effect may see of the assembled field."""

    @property
    def share(self) -> Mapping[str, FloatArray]:
        """Region -> (n_unknowns,): spreads one watt over the region; the same vector takes the region's mean."""

    @property
    def capacity_J_per_K(self) -> Mapping[str, float]:
        """Region -> declared capacity."""

    @property
    def epoch_ns(self) -> int | None:
        """Unix nanoseconds of the first sample, None without dates."""

    def joint_heat_W(self, nodes: tuple[str, str], temperature_K: FloatArray) -> FloatArray:
        """Return the declared joint's heat into every unknown, (n_unknowns,)."""

    def radiator_heat_W(self, node: str, sink: str, temperature_K: FloatArray, sink_K: float) -> FloatArray:
        """Return the declared radiator's heat into every unknown, (n_unknowns,)."""


class Declared(Protocol):
    """What an effect may ask of the scenario that holds it."""

    def pairs_joined(self) -> set[frozenset[str]]:
        """Return the pairs of regions with a joint or strap."""

    def radiating_pairs(self) -> set[tuple[str, str]]:
        """Return (region, sink) of every radiator."""

    def kind_of(self, channel: str) -> str:
        """Return the kind of a forcing channel."""

    def levels_of(self, channel: str) -> bool:
        """Return whether a forcing channel has levels."""


@dataclass(frozen=True)
class Moment:
    """The field at one instant, as an effect meets it."""

    plant: Plant
    time_s: float
    temperature_K: FloatArray
    rate_K_per_s: FloatArray
    boundary_K: Mapping[str, float]
    channels: Mapping[str, float]

    def mean_K(self, region: str) -> float:
        """Return the mean temperature of a region."""
        return float(self.plant.share[region] @ self.temperature_K)

    def mean_rate_K_per_s(self, region: str) -> float:
        """Return the mean rate of change of a region's temperature."""
        return float(self.plant.share[region] @ self.rate_K_per_s)


Heat = Callable[[Moment], FloatArray]


@dataclass(frozen=True)
class Bound:
    """An effect bound to a field: its heat, and what it does once at the start of every step (hysteresis)."""

    heat_W: Heat
    advance: Callable[[Moment], None] = lambda moment: None


@dataclass(frozen=True)
class Mass:
    """An unseen lumped mass behind a conductance that is spread over a region."""

    region: str
    capacity_J_per_K: float
    conductance_W_per_K: float


class HiddenEffect(BaseModel):
    """Base of all hidden effects: four hooks, each doing nothing unless overridden."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    effect: str
    channel_kind: ClassVar[str] = "power"

    @property
    def where(self) -> dict[str, Any]:
        """The place, in the words of a report."""
        found = {key: getattr(self, key) for key in WHERE_KEYS if key in type(self).model_fields}
        return {key: list(value) if isinstance(value, tuple) else value for key, value in found.items()}

    @property
    def parameters(self) -> dict[str, Any]:
        """Every other field: the size of the effect."""
        return {key: value for key, value in self.model_dump().items() if key not in (*WHERE_KEYS, "effect")}

    def problems(self, declared: Declared) -> Iterable[str]:
        """Yield what in the scenario contradicts this effect."""
        return ()

    def masses(self) -> tuple[Mass, ...]:
        """Return lumped masses to add to the field."""
        return ()

    def bind(self, plant: Plant) -> Bound | None:
        """Return the extra heat in the field, if any."""
        return None

    def deliver(self, declared: FloatArray, time_s: FloatArray, epoch_ns: int | None) -> FloatArray:
        """Return what a forcing channel delivers, given what it declares; asked only for the effect's own channel."""
        return declared

    def read(self, reading_K: FloatArray, time_s: FloatArray, epoch_ns: int | None) -> FloatArray:
        """Return what a sensor reads, given the true temperature; asked only for the effect's own sensor."""
        return reading_K


class LumpedHeat(HiddenEffect):
    """Base of effects that are heat into whole regions, spread evenly over each, driven by region means."""

    @abstractmethod
    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return region -> heat (W), positive into the region."""

    def bind(self, plant: Plant) -> Bound | None:
        """Spread the heats over their regions."""
        return Bound(lambda moment: spread(plant, self.heats_W(moment)))


def spread(plant: Plant, heats_W: Mapping[str, float]) -> FloatArray:
    """Return heats per region as heat into every unknown, (n_unknowns,)."""
    return sum(  # type: ignore[return-value]
        (heat * plant.share[region] for region, heat in heats_W.items()), start=0.0 * next(iter(plant.share.values()))
    )


def seconds(time: Instant, epoch_ns: int | None) -> float:
    """Return an instant as seconds from the first sample."""
    if isinstance(time, str):
        return (parse_instant_ns(time) - (epoch_ns or 0)) / 1e9
    return float(time)
