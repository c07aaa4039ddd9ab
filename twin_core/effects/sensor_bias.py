"""A sensor that reads too much or too little from an instant on: a cracked bond, a new range, a changed reference."""

from collections.abc import Iterable
from dataclasses import dataclass

from twin_core._typing import FloatArray
from twin_core.effects.base import ParameterSpec, Where
from twin_core.effects.onset import OnsetEffect
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Reading
from twin_core.parameters.parameter import Parameter


@dataclass(frozen=True)
class Bias:
    """reads + b, from an instant on."""

    sensor: int
    effect: "SensorBias"
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, time_s: FloatArray, values: FloatArray) -> Reading:
        """Evaluate the offset."""
        share, slope = self.effect.ramp(time_s, values[1])
        return Reading(self.sensor, values[0] * share, [(0, share), (1, values[0] * slope)])


class SensorBias(OnsetEffect):
    """reads + b from an instant on."""

    name = "sensor_bias"
    keys = ("sensor",)
    equation = "reading = T + b from time on"
    reference = "Gertler, Fault Detection and Diagnosis in Engineering Systems, ch. 3 (additive sensor faults)"
    sentence = "sensor {sensor} has read with an offset since an instant in the record"
    amplitude = ParameterSpec("b_K", "K", null=0.0)

    @property
    def blind_s(self) -> float:
        """One sampling interval: the onset lies anywhere between the last good sample and the first bad one."""
        return float(self.settings["width_s"])

    def addition(self, layout: Layout) -> Addition:
        """Return the offset of the sensor."""
        term = Bias(layout.sensor(self.where["sensor"]), self, self.parameters())
        return Addition(readings=(term,), dated=self.settings["dated"])

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every sensor."""
        yield from ({"sensor": sensor} for sensor in layout.spec.sensors)
