"""Hidden losses of an input: what a channel delivers is not what it declares."""

from typing import Literal

import numpy as np

from twin_core._typing import FloatArray
from twin_core.fem.hidden.base import HiddenEffect, Instant, seconds
from twin_core.network.quantities import Name, Number, Positive


class InputGain(HiddenEffect):
    """delivered = g x declared."""

    effect: Literal["input_gain"]
    channel: Name
    g: Positive

    def deliver(self, declared: FloatArray, time_s: FloatArray, epoch_ns: int | None) -> FloatArray:
        """Scale the channel."""
        return self.g * declared


class InputPowerLaw(HiddenEffect):
    """delivered = declared x (declared / reference)^(n - 1); nothing where nothing is declared."""

    effect: Literal["input_power_law"]
    channel: Name
    n: Positive
    reference: Positive

    def deliver(self, declared: FloatArray, time_s: FloatArray, epoch_ns: int | None) -> FloatArray:
        """Bend the channel; the sign of the declared value is kept."""
        return np.sign(declared) * self.reference * np.abs(declared / self.reference) ** self.n


class InputStep(HiddenEffect):
    """delivered = f x declared from an instant on (f = 0: a dead heater)."""

    effect: Literal["input_step"]
    channel: Name
    f: Number
    time: Instant

    def deliver(self, declared: FloatArray, time_s: FloatArray, epoch_ns: int | None) -> FloatArray:
        """Scale the channel after the instant."""
        return np.where(time_s >= seconds(self.time, epoch_ns), self.f, 1.0) * declared


class InputDrift(HiddenEffect):
    """delivered = declared x (1 + r (t - t0)), t0 the first sample."""

    effect: Literal["input_drift"]
    channel: Name
    r_per_s: Number

    def deliver(self, declared: FloatArray, time_s: FloatArray, epoch_ns: int | None) -> FloatArray:
        """Let the channel drift; before the first sample it is undisturbed."""
        return (1.0 + self.r_per_s * np.maximum(time_s, 0.0)) * declared
