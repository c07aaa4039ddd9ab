"""Undeclared radiation between two nodes: faces that see each other, a blanket that lets heat through."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Entry, Heat, pair_jacobian
from twin_core.parameters.parameter import Parameter


@dataclass(frozen=True)
class PairRadiation:
    """q_a = -q_b = sigma R (T_b^4 - T_a^4)."""

    first: int
    second: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the exchange; what one node gains the other loses."""
        own, other = along.temperatures_K[:, self.first], along.temperatures_K[:, self.second]
        unit = STEFAN_BOLTZMANN_W_PER_M2_K4 * (other**4 - own**4)
        heat = values[0] * unit
        slope = 4.0 * STEFAN_BOLTZMANN_W_PER_M2_K4 * values[0]
        return Heat(
            (self.first, self.second),
            (heat[:, None] * [1.0, -1.0]),
            pair_jacobian(-slope * own**3, slope * other**3),
            [Entry(0, self.first, unit), Entry(0, self.second, -unit)],
            fourth_W_per_K4=STEFAN_BOLTZMANN_W_PER_M2_K4 * values[0] * np.array([[-1.0, 1.0], [1.0, -1.0]]),
        )


class RadiativeExchange(Effect):
    """q_a = -q_b = sigma R (T_b^4 - T_a^4)."""

    name = "radiative_exchange"
    keys = ("nodes",)
    equation = "q_a = -q_b = sigma R (T_b^4 - T_a^4)"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 15"
    sentence = "a radiative coupling between {first} and {second} was missing"
    driven_by = "radiation"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the exchange area."""
        return (ParameterSpec("R_m2", "m2", null=0.0, positive=True),)

    def addition(self, layout: Layout) -> Addition:
        """Return the exchange."""
        first, second = (layout.node(name) for name in self.where["nodes"])
        return Addition((PairRadiation(first, second, self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every pair of nodes: a conductor between two faces does not keep them from radiating."""
        yield from ({"nodes": list(pair)} for pair in combinations(layout.declared_nodes, 2))

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect: it is linear in R."""
        yield cls(where, {"R_m2": 0.0})
