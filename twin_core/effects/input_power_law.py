"""A heat input that is not proportional to its declared value: a voltage declared as if it were power."""

from collections.abc import Iterable
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, Quality, Survey, Where
from twin_core.effects.inputs import correct_channel, driving_channels
from twin_core.network.model import Addition, Layout


class InputPowerLaw(Effect):
    """delivered = declared * (declared / reference)^(n - 1)."""

    name = "input_power_law"
    keys = ("channel",)
    equation = "delivered = declared (declared / reference)^(n - 1)"
    reference = "Joule heating of a resistive load: P ~ U^2"
    words = "delivers heat that is not proportional to its declared value"
    reported_settings = ("reference",)

    def qualities(self) -> tuple[Quality, ...]:
        """Return the exponent; one is null."""
        return (Quality("n", "", null=1.0, positive=True, prior_std=1.0),)

    def addition(self, layout: Layout) -> Addition:
        """Return the corrections of the channel's loads."""
        reference = float(self.settings["reference"])

        def shape(declared: FloatArray, time_s: FloatArray, values: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
            ratio = np.maximum(declared, 0.0) / reference
            logarithm = np.log(np.maximum(ratio, 1e-12))
            delivered = np.where(ratio > 0.0, declared * np.exp((values[0] - 1.0) * logarithm), 0.0)
            return delivered - np.maximum(declared, 0.0), [delivered * logarithm]

        return correct_channel(self, layout, shape)

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every channel that drives a load."""
        yield from driving_channels(layout)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the null effect around the median of the channel's positive values, if it takes several."""
        series = survey.along.inputs.get(where["channel"], np.zeros(0))
        positive = series[series > 0.0]
        if positive.size and np.unique(np.round(positive / positive.max(), 3)).size >= 3:
            yield cls(where, {"n": 1.0}, {"reference": float(np.median(positive))})
