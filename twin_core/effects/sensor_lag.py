"""A sensor that follows its node late: a thermistor on a pad, a heater with the sensor glued on top."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.hidden_mass import first_order_lag
from twin_core.network.model import Addition, ExtraNode, Layout
from twin_core.network.terms import Along, Entry, Heat
from twin_core.parameters.parameter import Parameter, positive

N_TIME_CONSTANTS = 6

SCALED_UP_TO = 2.0
"""So many times the assumed time constant of a lag its response may be scaled to, a ratio: a longer one saturates, and the next
start, mostly two to three times as long, tells it better. A run of the temperature lab is told alike with half and twice as
much, and not at all without it."""


@dataclass(frozen=True)
class Lag:
    """dr/dt = (T - r) / tau for a reading r of unit capacity; the node feels nothing of it."""

    node: int
    reading: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the lag; the coupling has one direction."""
        difference = along.temperatures_K[:, self.node] - along.temperatures_K[:, self.reading]
        rate = 1.0 / values[0]
        jacobian = np.array([[[0.0, 0.0], [rate, -rate]]])
        heat = np.stack([np.zeros_like(difference), rate * difference], axis=1)
        return Heat((self.node, self.reading), heat, jacobian, [Entry(0, self.reading, -(rate**2) * difference)])


class SensorLag(Effect):
    """tau dr/dt = T - r: the sensor reads r."""

    name = "sensor_lag"
    keys = ("sensor",)
    equation = "tau dr/dt = T - r"
    reference = "First-order sensor dynamics; Doebelin, Measurement Systems, 5th ed., ch. 3"
    sentence = "sensor {sensor} lags behind the temperature of its node"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the time constant; a lag of zero is none."""
        return (ParameterSpec("tau_s", "s", null=0.0, positive=True),)

    @property
    def _state(self) -> str:
        return f"{self.where['sensor']}.reading"

    def extra_nodes(self, layout: Layout) -> tuple[ExtraNode, ...]:
        """Return the reading as a state of unit capacity that the sensor reads instead of its node."""
        unit = positive(f"{self.label}.unit", "J/K", 1.0, frozen=True)
        node = layout.sensor_node(self.where["sensor"])
        return (ExtraNode(self._state, unit, node, reads=self.where["sensor"]),)

    def addition(self, layout: Layout) -> Addition:
        """Return the lag."""
        node = layout.node(layout.sensor_node(self.where["sensor"]))
        return Addition((Lag(node, layout.node(self._state), self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every sensor."""
        yield from ({"sensor": sensor} for sensor in layout.spec.sensors)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield time constants from half a sample to a hundred."""
        steps = np.diff(survey.along.time_s)
        sampling = float(np.median(steps[steps > 0]))
        for tau in np.geomspace(0.5 * sampling, 100.0 * sampling, N_TIME_CONSTANTS):
            yield cls(where, {"tau_s": 0.0}, {"start_s": float(tau)})

    @property
    def linear_up_to(self) -> float:
        """The time constant to which the response at the assumed one can be scaled: nearly that of the next start."""
        return SCALED_UP_TO * float(self.settings["start_s"])

    def unit_readings(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return the change of the reading per second of lag, at the lag that this start assumes."""
        node, tau = survey.layout.sensor_node(self.where["sensor"]), self.settings["start_s"]
        temperature = survey.temperature_K(node)
        change = np.empty_like(temperature)
        for s in survey.segments():
            change[s] = (first_order_lag(survey.along.time_s[s], temperature[s], tau) - temperature[s]) / tau
        return [[(survey.layout.sensor(self.where["sensor"]), change)]]

    def unit_heats(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return no heat: the lag is in the sensor."""
        return [[]]
