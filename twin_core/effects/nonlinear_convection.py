"""Undeclared convection to a boundary whose coefficient grows with the difference: natural convection, a draught."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Entry, Heat
from twin_core.parameters.parameter import Parameter

EXPONENTS = (1.25, 1.5, 2.0)
"""Laminar natural convection, what lies between, and flow that the difference itself drives."""

STEEPEST = 4.0
"""No convection is steeper; nucleate boiling, with an exponent of about three, comes nearest. What switches, as a fan does, would
take any exponent, and such a law runs away wherever the difference grows a little beyond what the record visits. A measured
inverter with a fan was predicted at 28.5 K without a limit, and at 1.9, 2.0 and 1.4 K with one of 3, 4 and 8."""

ROUNDING_K = 0.01
"""Below this difference the heat is linear in it, so that the slope is bounded for any exponent."""


@dataclass(frozen=True)
class PowerConvection:
    """q = k d |d|^(p - 1), d = T_s - T; values are k and p."""

    node: int
    boundary: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the convection with |d| as sqrt(d^2 + rounding^2)."""
        k, p = values
        difference = along.boundaries_K[:, self.boundary] - along.temperatures_K[:, self.node]
        square = difference**2 + ROUNDING_K**2
        power = np.exp(0.5 * (p - 1.0) * np.log(square))
        unit = difference * power
        slope = k * power * (1.0 + (p - 1.0) * difference**2 / square)
        return Heat(
            (self.node,),
            (k * unit)[:, None],
            -slope[:, None, None],
            [Entry(0, self.node, unit), Entry(1, self.node, 0.5 * k * unit * np.log(square))],
            [Entry(self.boundary, self.node, slope)],
        )


class NonlinearConvection(Effect):
    """q = k sgn(d) |d|^p, d = T_s - T."""

    name = "nonlinear_convection"
    keys = ("node", "boundary")
    equation = "q = k sgn(d) |d|^p, d = T_s - T"
    reference = "Incropera et al., Fundamentals of Heat and Mass Transfer, 7th ed., ch. 9"
    sentence = "convection from {node} to {boundary} was missing"
    driven_by = "difference"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return coefficient and exponent."""
        return (
            ParameterSpec("k", "W/K^p", null=0.0, positive=True),
            ParameterSpec("p", "", positive=True, prior_std=0.5, upper=STEEPEST),
        )

    def addition(self, layout: Layout) -> Addition:
        """Return the convection."""
        node, boundary = layout.node(self.where["node"]), layout.boundary(self.where["boundary"])
        return Addition((PowerConvection(node, boundary, self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node with every boundary."""
        yield from ({"node": node, "boundary": name} for node in layout.declared_nodes for name in layout.boundaries)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the null effect at the exponents that textbooks know."""
        yield from (cls(where, {"k": 0.0, "p": exponent}) for exponent in EXPONENTS)
