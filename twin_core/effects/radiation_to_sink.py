"""Undeclared radiation from a node to a sink: a lost blanket, a wrong emittance, a face that sees space."""

from collections.abc import Iterable
from typing import Self

from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import SinkRadiation


class RadiationToSink(Effect):
    """q = sigma R (T_s^4 - T^4)."""

    name = "radiation_to_sink"
    keys = ("node", "sink")
    equation = "q = sigma R (T_s^4 - T^4)"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 2"
    sentence = "radiation from {node} to {sink} was missing"
    driven_by = "radiation"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the exchange area R = emissivity * area * view factor."""
        return (ParameterSpec("R_m2", "m2", null=0.0, positive=True),)

    def addition(self, layout: Layout) -> Addition:
        """Return the radiation term."""
        node, sink = layout.node(self.where["node"]), layout.boundary(self.where["sink"])
        return Addition((SinkRadiation(node, sink, self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node with every boundary."""
        yield from ({"node": node, "sink": sink} for node in layout.declared_nodes for sink in layout.boundaries)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect: it is linear in R."""
        yield cls(where, {"R_m2": 0.0})
