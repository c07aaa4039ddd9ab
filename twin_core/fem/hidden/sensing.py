"""Hidden sensor faults: the region is well, the reading is not."""

from typing import Literal

import numpy as np

from twin_core._typing import FloatArray
from twin_core.fem.hidden.base import HiddenEffect, Instant, seconds
from twin_core.network.quantities import Name, Number, Positive


class SensorBias(HiddenEffect):
    """Reads b too much from an instant on."""

    effect: Literal["sensor_bias"]
    sensor: Name
    b_K: Number
    time: Instant

    def read(self, reading_K: FloatArray, time_s: FloatArray, epoch_ns: int | None) -> FloatArray:
        """Shift the reading."""
        return reading_K + np.where(time_s >= seconds(self.time, epoch_ns), self.b_K, 0.0)


class SensorDrift(HiddenEffect):
    """Reads d (t - t0) too much, t0 the first sample."""

    effect: Literal["sensor_drift"]
    sensor: Name
    d_K_per_s: Number

    def read(self, reading_K: FloatArray, time_s: FloatArray, epoch_ns: int | None) -> FloatArray:
        """Let the reading drift."""
        return reading_K + self.d_K_per_s * np.maximum(time_s, 0.0)


class SensorLag(HiddenEffect):
    """Follows with a first-order lag: tau dy/dt = x - y, exact for x linear between the steps."""

    effect: Literal["sensor_lag"]
    sensor: Name
    tau_s: Positive

    def read(self, reading_K: FloatArray, time_s: FloatArray, epoch_ns: int | None) -> FloatArray:
        """Filter the reading, which starts settled."""
        lagged = reading_K.copy()
        for n, step_s in enumerate(np.diff(time_s)):
            slope = (reading_K[n + 1] - reading_K[n]) / step_s
            # On a ramp the settled reading trails by slope * tau; what is left of the start decays.
            trailing = reading_K[n] - slope * self.tau_s
            decay = np.exp(-step_s / self.tau_s)
            lagged[n + 1] = trailing + slope * step_s + (lagged[n] - trailing) * decay
        return lagged
