"""A heat input that changes at an instant: a dead heater, a lost string, a switch to a redundant circuit."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import ParameterSpec, Survey, Where
from twin_core.effects.inputs import correct_channel, driving_channels
from twin_core.effects.onset import OnsetEffect
from twin_core.network.model import Addition, Layout


class InputStep(OnsetEffect):
    """delivered = f * declared from an instant on."""

    name = "input_step"
    keys = ("channel",)
    equation = "delivered = f declared from time on"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 7"
    sentence = "the heat of {channel} changed by a constant factor during the record"
    amplitude = ParameterSpec("f", "", null=1.0, lower=0.0)

    def addition(self, layout: Layout) -> Addition:
        """Return the corrections of the channel's loads."""
        return correct_channel(self, layout, self._beyond, dated=self.settings["dated"])

    def _beyond(
        self, declared: FloatArray, clock_s: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, list[FloatArray]]:
        change, slopes = self.change(clock_s, values)
        return change * declared, [slope * declared for slope in slopes]

    def centred(self, survey: Survey) -> Self:
        """Return the onset in the middle of the time in which the input is off, if it lies in or next to such a time."""
        time, width = self.values["time"], self.settings["width_s"]
        for window in survey.segments():
            clock, off = survey.along.time_s[window], survey.along.inputs[self.where["channel"]][window] == 0.0
            near = np.flatnonzero(off & (np.abs(clock - time) <= width))
            if near.size:
                on = np.concatenate([[-1], np.flatnonzero(~off), [off.size]])
                after = int(np.searchsorted(on, near[0]))
                begin, end = clock[on[after - 1] + 1], clock[on[after] - 1]
                moved = self.with_values({"time": float(0.5 * (begin + end))})
                return replace(moved, settings={**self.settings, "blind_s": float(end - begin)})
        return self

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every channel that drives a load."""
        yield from driving_channels(layout)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield onsets over the record of a channel that is on at times."""
        if np.any(survey.along.inputs.get(where["channel"], 0.0)):
            yield from super().starts(where, survey)
