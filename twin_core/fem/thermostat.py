"""Declared thermostats: heaters that switch on what they feel, and whose power is telemetry."""

from typing import Self

import numpy as np
from pydantic import model_validator

from twin_core._typing import FloatArray
from twin_core.fem.parts import Part
from twin_core.fem.signals import Path
from twin_core.network.quantities import Name, Positive, Temperature
from twin_core.network.spec import Channel


class Thermostat(Part):
    """Full power into a region once its mean is below T_on, until it is above T_off; it looks at every sample.

    The channel carries the power, which holds from sample to sample: the record tells exactly what was delivered.
    """

    channel: Name
    region: Name
    Q_W: Positive
    T_on_K: Temperature
    T_off_K: Temperature

    @model_validator(mode="after")
    def _band_is_upright(self) -> Self:
        if self.T_on_K >= self.T_off_K:
            raise ValueError(f"T_on_K ({self.T_on_K:g}) must be below T_off_K ({self.T_off_K:g})")
        return self

    @property
    def telemetry(self) -> Channel:
        """The channel as a telemetry writer knows it."""
        return Channel(kind="power", unit="W")


class Switch:
    """A thermostat at work: it starts off, remembers its state, and keeps what it delivered in every step."""

    def __init__(self, thermostat: Thermostat, share: FloatArray, sample_s: float) -> None:
        self.thermostat, self.share, self._sample_s = thermostat, share, sample_s
        self._is_on = False
        self._power_W: list[float] = []

    def look(self, time_s: float, temperature_K: FloatArray) -> None:
        """Decide at the start of a step; between samples nothing changes."""
        phase = time_s / self._sample_s
        if abs(phase - round(phase)) < 1e-6:
            felt_K = float(self.share @ temperature_K)
            self._is_on = felt_K < self.thermostat.T_on_K or (self._is_on and felt_K < self.thermostat.T_off_K)
        self._power_W.append(self.thermostat.Q_W if self._is_on else 0.0)

    @property
    def heat_W(self) -> FloatArray:
        """Heat into every unknown now, (n_unknowns,)."""
        return self._power_W[-1] * self.share

    def path(self, start_s: FloatArray) -> Path:
        """Return the power over time, from what was delivered in the steps that began at ``start_s`` (n_steps,)."""
        power_W = np.array(self._power_W)
        return lambda time_s: power_W[np.searchsorted(start_s, np.asarray(time_s) + 1e-6, side="right") - 1]
