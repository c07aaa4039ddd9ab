"""Hidden storage: heat that goes into a region, or into a mass behind it, beyond the declared capacity."""

from collections.abc import Mapping
from typing import Literal

import numpy as np

from twin_core.fem.hidden.base import Bound, HiddenEffect, LumpedHeat, Mass, Moment, Plant, spread
from twin_core.network.quantities import Name, Number, Positive, Temperature


class HiddenMass(HiddenEffect):
    """An unseen capacity behind a conductance; it starts at the region's temperature."""

    effect: Literal["hidden_mass"]
    node: Name
    C_J_per_K: Positive
    G_W_per_K: Positive

    def masses(self) -> tuple[Mass, ...]:
        """Return the one mass."""
        return (Mass(self.node, self.C_J_per_K, self.G_W_per_K),)


class CapacityTemperature(HiddenEffect):
    """C becomes C (1 + kappa (T - T_ref)): the extra capacity takes up kappa C (T - T_ref) dT/dt."""

    effect: Literal["capacity_temperature"]
    node: Name
    kappa_per_K: Number
    T_ref_K: Temperature

    def bind(self, plant: Plant) -> Bound:
        """Return minus the heat that the extra capacity takes up."""
        capacity = plant.capacity_J_per_K[self.node]

        def heats_W(moment: Moment) -> Mapping[str, float]:
            extra = self.kappa_per_K * capacity * (moment.mean_K(self.node) - self.T_ref_K)
            return {self.node: -extra * moment.mean_rate_K_per_s(self.node)}

        return Bound(lambda moment: spread(plant, heats_W(moment)))


class LatentHeat(LumpedHeat):
    """A phase change: extra capacity L / (w sqrt(2 pi)) exp(-(T - T_m)^2 / (2 w^2)), area L."""

    effect: Literal["latent_heat"]
    node: Name
    L_J: Positive
    T_m_K: Temperature
    w_K: Positive

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return minus the heat that the phase change takes up."""
        standard = (moment.mean_K(self.node) - self.T_m_K) / self.w_K
        capacity = self.L_J / (self.w_K * np.sqrt(2.0 * np.pi)) * np.exp(-0.5 * standard**2)
        return {self.node: float(-capacity * moment.mean_rate_K_per_s(self.node))}
