"""An undeclared linear heat path from a node to a boundary."""

from collections.abc import Iterable
from typing import Self

from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import BoundaryConductor


class LeakToBoundary(Effect):
    """q = G (T_s - T)."""

    name = "leak_to_boundary"
    keys = ("node", "boundary")
    equation = "q = G (T_s - T)"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 15"
    sentence = "a heat leak from {node} to {boundary} was missing"
    driven_by = "difference"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the conductance."""
        return (ParameterSpec("G_W_per_K", "W/K", null=0.0, positive=True),)

    def addition(self, layout: Layout) -> Addition:
        """Return the path."""
        node, boundary = layout.node(self.where["node"]), layout.boundary(self.where["boundary"])
        return Addition((BoundaryConductor(node, boundary, self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node with every boundary that no declared conductor joins."""
        for node in layout.declared_nodes:
            for boundary in layout.boundaries:
                if frozenset((node, boundary)) not in layout.node_pairs:
                    yield {"node": node, "boundary": boundary}

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect: it is linear in G."""
        yield cls(where, {"G_W_per_K": 0.0})
