"""A heat input that is not proportional to its declared value: a voltage declared as if it were power."""

from collections.abc import Iterable
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.inputs import correct_channel, driving_channels, gain_is_known
from twin_core.network.model import Addition, Layout

N_REFERENCES = 3
"""References that are tried, from the least positive value of a channel to the largest."""

LEAST_LEVELS = 2
"""One level above zero delivers what a gain does."""


class InputPowerLaw(Effect):
    """delivered = declared * (declared / reference)^(n - 1).

    Where the loads' gain is unknown it takes the place of the reference, which is then a setting.
    """

    name = "input_power_law"
    keys = ("channel",)
    equation = "delivered = declared (declared / reference)^(n - 1)"
    reference = "Joule heating of a resistive load: P ~ U^2"
    sentence = "the heat of {channel} is not proportional to its declared value"
    reported_settings = ("reference",)

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the exponent, one is null, and the value at which what is delivered is what is declared."""
        exponent = ParameterSpec("n", "", null=1.0, positive=True, prior_std=1.0)
        return (
            (exponent,)
            if "reference" in self.settings
            else (exponent, ParameterSpec("reference", "", positive=True, prior_std=1.0))
        )

    def addition(self, layout: Layout) -> Addition:
        """Return the corrections of the channel's loads."""
        return correct_channel(self, layout, self._beyond)

    def _beyond(
        self, declared: FloatArray, time_s: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, list[FloatArray]]:
        held = self.settings.get("reference")
        exponent, reference = values[0], float(held) if held is not None else values[1]
        ratio = np.maximum(declared, 0.0) / reference
        logarithm = np.log(np.maximum(ratio, 1e-12))
        delivered = np.where(ratio > 0.0, declared * np.exp((exponent - 1.0) * logarithm), 0.0)
        slopes = [delivered * logarithm, -(exponent - 1.0) / reference * delivered]
        return delivered - np.maximum(declared, 0.0), slopes[: values.size]

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every channel that drives a load, but those of the orbit: what light a surface absorbs is a share of it."""
        yield from (where for where in driving_channels(layout) if where["channel"] not in layout.spec.orbit_channels)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the null effect around several values of the channel, if it takes several above zero."""
        series = survey.along.inputs.get(where["channel"], np.zeros(0))
        positive = series[series > 0.0]
        if not positive.size or np.unique(np.round(positive / positive.max(), 3)).size < LEAST_LEVELS:
            return
        if not gain_is_known(survey.layout, where["channel"]):
            yield cls(where, {"n": 1.0}, {"reference": float(np.median(positive))})
            return
        for reference in np.geomspace(positive.min(), positive.max(), N_REFERENCES):
            yield cls(where, {"n": 1.0, "reference": float(reference)})
