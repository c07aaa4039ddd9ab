"""An undeclared constant heat input: a dissipation that nobody listed, a stuck-on heater."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Entry, Heat
from twin_core.parameters.parameter import Parameter


@dataclass(frozen=True)
class ConstantHeat:
    """q = Q."""

    node: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the load."""
        one = np.ones(along.time_s.size)
        return Heat((self.node,), (values[0] * one)[:, None], np.zeros((1, 1, 1)), [Entry(0, self.node, one)])


class ConstantHeatLoad(Effect):
    """q = Q."""

    name = "constant_heat_load"
    keys = ("node",)
    equation = "q = Q"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 2"
    sentence = "a constant heat load on {node} was missing"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the heat."""
        return (ParameterSpec("Q_W", "W", null=0.0),)

    def addition(self, layout: Layout) -> Addition:
        """Return the load."""
        return Addition((ConstantHeat(layout.node(self.where["node"]), self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node."""
        yield from ({"node": node} for node in layout.declared_nodes)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect: it is linear in Q."""
        yield cls(where, {"Q_W": 0.0})
