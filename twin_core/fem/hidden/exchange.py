"""Hidden exchanges: heat that flows between regions, or to a boundary, along a path that nobody declared."""

from collections.abc import Mapping
from typing import Literal

import numpy as np

from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.fem.hidden.base import LumpedHeat, Moment
from twin_core.network.quantities import Name, Positive


class RadiationToSink(LumpedHeat):
    """A surface that sees a sink: q = sigma R (T_s^4 - T^4)."""

    effect: Literal["radiation_to_sink"]
    node: Name
    sink: Name
    R_m2: Positive

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return the heat into the region."""
        fourth = moment.boundary_K[self.sink] ** 4 - moment.mean_K(self.node) ** 4
        return {self.node: STEFAN_BOLTZMANN_W_PER_M2_K4 * self.R_m2 * fourth}


class RadiativeExchange(LumpedHeat):
    """Two regions that see each other: q_a = -q_b = sigma R (T_b^4 - T_a^4)."""

    effect: Literal["radiative_exchange"]
    nodes: tuple[Name, Name]
    R_m2: Positive

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return equal and opposite heats."""
        a, b = self.nodes
        heat = STEFAN_BOLTZMANN_W_PER_M2_K4 * self.R_m2 * (moment.mean_K(b) ** 4 - moment.mean_K(a) ** 4)
        return {a: heat, b: -heat}


class MissingConductor(LumpedHeat):
    """A strap between two regions: q_a = -q_b = G (T_b - T_a)."""

    effect: Literal["missing_conductor"]
    nodes: tuple[Name, Name]
    G_W_per_K: Positive

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return equal and opposite heats."""
        a, b = self.nodes
        heat = self.G_W_per_K * (moment.mean_K(b) - moment.mean_K(a))
        return {a: heat, b: -heat}


class LeakToBoundary(LumpedHeat):
    """A path to a boundary: q = G (T_s - T)."""

    effect: Literal["leak_to_boundary"]
    node: Name
    boundary: Name
    G_W_per_K: Positive

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return the heat into the region."""
        return {self.node: self.G_W_per_K * (moment.boundary_K[self.boundary] - moment.mean_K(self.node))}


class NonlinearConvection(LumpedHeat):
    """Convection to a gas: q = k sgn(D) |D|^p with D = T_s - T."""

    effect: Literal["nonlinear_convection"]
    node: Name
    boundary: Name
    k: Positive
    p: Positive

    def heats_W(self, moment: Moment) -> Mapping[str, float]:
        """Return the heat into the region."""
        difference = moment.boundary_K[self.boundary] - moment.mean_K(self.node)
        return {self.node: self.k * float(np.sign(difference)) * abs(difference) ** self.p}
