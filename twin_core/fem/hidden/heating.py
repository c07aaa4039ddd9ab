"""Hidden heating: heat that appears in a region without being declared."""

from collections.abc import Iterable, Mapping
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from twin_core.fem.hidden.base import Bound, Declared, HiddenEffect, LumpedHeat, Moment, Plant, spread
from twin_core.network.quantities import Name, Number, Positive, Temperature


class ConstantHeatLoad(LumpedHeat):
    """q = Q: a dissipation that nobody declared, or one that is not there (negative)."""

    effect: Literal["constant_heat_load"]
    node: Name
    Q_W: Number

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return the heat into the region."""
        return {self.node: self.Q_W}


class PeriodicHeatLoad(LumpedHeat):
    """q = Q + A sin(2 pi t / P) + B cos(2 pi t / P)."""

    effect: Literal["periodic_heat_load"]
    node: Name
    Q_W: Number
    A_W: Number
    B_W: Number
    P_s: Positive

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return the heat into the region."""
        angle = 2.0 * np.pi * moment.time_s / self.P_s
        return {self.node: float(self.Q_W + self.A_W * np.sin(angle) + self.B_W * np.cos(angle))}


class ChannelHeatLoad(LumpedHeat):
    """q = f(x) of an auxiliary channel: piecewise linear over knots, or one value per level."""

    effect: Literal["channel_heat_load"]
    channel_kind: ClassVar[str] = "auxiliary"
    node: Name
    channel: Name
    knots: tuple[Number, ...]
    values_W: tuple[Number, ...]

    @model_validator(mode="after")
    def _columns_match(self) -> Self:
        if len(self.knots) != len(self.values_W) or len(self.knots) < 2:
            raise ValueError(
                f"knots ({len(self.knots)}) and values_W ({len(self.values_W)}) must be equally many, >= 2"
            )
        if any(b <= a for a, b in zip(self.knots, self.knots[1:], strict=False)):
            raise ValueError("knots must strictly increase")
        return self

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return the heat into the region; a channel with levels only ever meets the knots themselves."""
        return {self.node: float(np.interp(moment.channels[self.channel], self.knots, self.values_W))}


class ProportionalHeater(LumpedHeat):
    """q = min(Q, k (T_set - T)) below T_set, else 0."""

    effect: Literal["proportional_heater"]
    node: Name
    k_W_per_K: Positive
    T_set_K: Temperature
    Q_W: Positive

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return the heat into the region."""
        return {self.node: float(np.clip(self.k_W_per_K * (self.T_set_K - moment.mean_K(self.node)), 0.0, self.Q_W))}


class ThermostatHeater(HiddenEffect):
    """Full power once below T_on until above T_off (hysteresis); it looks once per step."""

    effect: Literal["thermostat_heater"]
    node: Name
    Q_W: Positive
    T_on_K: Temperature
    T_off_K: Temperature

    def problems(self, declared: Declared) -> Iterable[str]:
        """Yield a dead band that is upside down."""
        if self.T_on_K >= self.T_off_K:
            yield f"T_on_K ({self.T_on_K:g}) must be below T_off_K ({self.T_off_K:g})"

    def bind(self, plant: Plant) -> Bound:
        """Return the heat with a memory of whether the heater is on; it starts off."""
        on = [False]

        def advance(moment: Moment) -> None:
            temperature = moment.mean_K(self.node)
            on[0] = temperature < self.T_on_K or (on[0] and temperature < self.T_off_K)

        return Bound(lambda moment: spread(plant, {self.node: self.Q_W if on[0] else 0.0}), advance)
