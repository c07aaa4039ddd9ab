"""An undeclared linear coupling between two nodes: a strap, a harness, a touching bracket."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Entry, Heat, pair_jacobian
from twin_core.parameters.parameter import Parameter


@dataclass(frozen=True)
class PairConductor:
    """q_a = -q_b = G (T_b - T_a)."""

    first: int
    second: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the exchange; what one node gains the other loses."""
        difference = along.temperatures_K[:, self.second] - along.temperatures_K[:, self.first]
        heat = values[0] * difference
        slope = np.array([values[0]])
        return Heat(
            (self.first, self.second),
            np.stack([heat, -heat], axis=1),
            pair_jacobian(-slope, slope),
            [Entry(0, self.first, difference), Entry(0, self.second, -difference)],
        )


class MissingConductor(Effect):
    """q_a = -q_b = G (T_b - T_a)."""

    name = "missing_conductor"
    keys = ("nodes",)
    equation = "q_a = -q_b = G (T_b - T_a)"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 15"
    sentence = "a conductor between {first} and {second} was missing"
    driven_by = "difference"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the conductance."""
        return (ParameterSpec("G_W_per_K", "W/K", null=0.0, positive=True),)

    def addition(self, layout: Layout) -> Addition:
        """Return the coupling."""
        first, second = (layout.node(name) for name in self.where["nodes"])
        return Addition((PairConductor(first, second, self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every pair of nodes that no declared conductor joins."""
        for first, second in combinations(layout.declared_nodes, 2):
            if frozenset((first, second)) not in layout.node_pairs:
                yield {"nodes": [first, second]}

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect: it is linear in G."""
        yield cls(where, {"G_W_per_K": 0.0})
