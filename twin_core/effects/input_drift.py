"""A heat input that drifts away from its declared value: an ageing heater, a darkening surface, a drifting meter."""

from collections.abc import Iterable
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.inputs import correct_channel, driving_channels
from twin_core.network.model import Addition, Layout


class InputDrift(Effect):
    """delivered = declared * (1 + r (t - t0)), never less than nothing."""

    name = "input_drift"
    keys = ("channel",)
    equation = "delivered = declared max(1 + r (t - t0), 0)"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 4 (degradation of absorptance)"
    sentence = "the heat of {channel} drifted away from its declared value"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the rate of change."""
        return (ParameterSpec("r_per_s", "1/s", null=0.0),)

    def addition(self, layout: Layout) -> Addition:
        """Return the corrections of the channel's loads."""
        return correct_channel(self, layout, self._beyond, dated=self.settings["dated"])

    def _beyond(
        self, declared: FloatArray, clock_s: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, list[FloatArray]]:
        elapsed_s = clock_s - self.settings["t0_s"]
        change = values[0] * elapsed_s
        slope = np.where(change > -1.0, elapsed_s, 0.0)
        return np.maximum(change, -1.0) * declared, [slope * declared]

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every channel that drives a load."""
        yield from driving_channels(layout)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect of a channel that is on at times: it is linear in r."""
        if survey.one_clock and np.any(survey.along.inputs.get(where["channel"], 0.0)):
            yield cls(where, {"r_per_s": 0.0}, {"t0_s": survey.begin_s, "dated": survey.dated})
