"""A capacity that changes with temperature: polymers, propellants, cryogenic metals."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.straight_line import range_of_slope, slope_spec
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Capacity, Entry
from twin_core.parameters.parameter import Parameter

LEAST_SHARE = 0.2
"""Below this share of the declared capacity the straight line bends into a hyperbola that stays positive."""


@dataclass(frozen=True)
class LinearCapacity:
    """C -> C (1 + kappa (T - T_ref)); values are kappa and the declared C."""

    node: int
    reference_K: float
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...]

    def evaluate(self, temperature_K: FloatArray, values: FloatArray) -> Capacity:
        """Evaluate the change of capacity; the node's own capacity is borrowed."""
        kappa, capacity = values
        away = temperature_K - self.reference_K
        line = 1.0 + kappa * away
        bent = line < LEAST_SHARE
        bend = 1.0 / (2.0 - np.minimum(line / LEAST_SHARE, 1.0))
        share = np.where(bent, LEAST_SHARE * bend, line)
        slope = bend**2
        # The integral of share - 1 over temperature: a parabola, and on from where the line bends a logarithm.
        stored, d_stored = 0.5 * kappa * away**2, 0.5 * away**2
        if bent.any():
            beyond = 0.5 * (LEAST_SHARE**2 + 1.0) + LEAST_SHARE**2 * np.log(bend) - line
            stored = np.where(bent, beyond / kappa, stored)
            d_stored = np.where(bent, (share - 1.0) * away / kappa - beyond / kappa**2, d_stored)
        return Capacity(
            self.node,
            capacity * (share - 1.0),
            capacity * slope * kappa,
            [Entry(0, self.node, capacity * slope * away), Entry(1, self.node, share - 1.0)],
            capacity * stored,
            [Entry(0, self.node, capacity * d_stored), Entry(1, self.node, stored)],
        )


class CapacityTemperature(Effect):
    """C -> C (1 + kappa (T - T_ref))."""

    name = "capacity_temperature"
    keys = ("node",)
    equation = "C -> C (1 + kappa (T - T_ref)), T_ref = mean T of the training record"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 15: temperature-dependent properties"
    sentence = "the heat capacity of {node} depends on temperature"
    reported_settings = ("T_ref_K",)

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the relative change of capacity per kelvin."""
        return (slope_spec("kappa_per_K", self.settings),)

    def addition(self, layout: Layout) -> Addition:
        """Return the change of capacity."""
        node = self.where["node"]
        reference = float(self.settings["T_ref_K"])
        term = LinearCapacity(layout.node(node), reference, self.parameters(), (f"C:{node}",))
        return Addition(capacities=(term,))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node."""
        yield from ({"node": node} for node in layout.declared_nodes)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the null effect about the mean temperature."""
        temperature_K = survey.temperature_K(where["node"])
        reference_K = float(temperature_K.mean())
        within = range_of_slope(temperature_K, reference_K, LEAST_SHARE)
        yield cls(where, {"kappa_per_K": 0.0}, {"T_ref_K": reference_K, **within})
