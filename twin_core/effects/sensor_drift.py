"""A sensor that drifts away from the truth: an ageing thermistor, a leaking reference."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Reading
from twin_core.parameters.parameter import Parameter


@dataclass(frozen=True)
class Drift:
    """reads + d (t - t0)."""

    sensor: int
    begin_s: float
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, time_s: FloatArray, values: FloatArray) -> Reading:
        """Evaluate the offset."""
        elapsed = time_s - self.begin_s
        return Reading(self.sensor, values[0] * elapsed, [(0, elapsed)])


class SensorDrift(Effect):
    """reads + d (t - t0), t0 being the first sample of the training record."""

    name = "sensor_drift"
    keys = ("sensor",)
    equation = "reading = T + d (t - t0)"
    reference = "Gertler, Fault Detection and Diagnosis in Engineering Systems, ch. 3 (additive sensor faults)"
    sentence = "sensor {sensor} drifted"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the rate of the drift."""
        return (ParameterSpec("d_K_per_s", "K/s", null=0.0),)

    def addition(self, layout: Layout) -> Addition:
        """Return the offset of the sensor."""
        term = Drift(layout.sensor(self.where["sensor"]), self.settings["t0_s"], self.parameters())
        return Addition(readings=(term,), dated=self.settings["dated"])

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every sensor."""
        yield from ({"sensor": sensor} for sensor in layout.spec.sensors)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect: it is linear in d."""
        if survey.one_clock:
            yield cls(where, {"d_K_per_s": 0.0}, {"t0_s": survey.begin_s, "dated": survey.dated})
