"""A heat input that delivers another share than declared: a lossy heater, a wrong absorptance, a mis-scaled sensor."""

from collections.abc import Iterable
from typing import Self

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.inputs import correct_channel, driving_channels, gain_is_known
from twin_core.network.model import Addition, Layout


def _shape(declared: FloatArray, time_s: FloatArray, values: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    return (values[0] - 1.0) * declared, [declared]


class InputGain(Effect):
    """delivered = g * declared."""

    name = "input_gain"
    keys = ("channel",)
    equation = "delivered = g declared"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 7"
    sentence = "the declared heat of {channel} is off by a constant factor"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the gain; one is null."""
        return (ParameterSpec("g", "", null=1.0, positive=True),)

    def addition(self, layout: Layout) -> Addition:
        """Return the corrections of the channel's loads."""
        return correct_channel(self, layout, _shape)

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every channel whose gain is known: an unknown one is calibrated anyway."""
        yield from (where for where in driving_channels(layout) if gain_is_known(layout, where["channel"]))

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect: it is linear in g."""
        yield cls(where, {"g": 1.0})
