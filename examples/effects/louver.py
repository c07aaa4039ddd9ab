"""A louver that nobody declared: blades over a radiator that open as it warms.

Use it with ``twin close-loop --effects examples/effects/louver.py ...``; ``docs/effects.md`` walks through this file.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Entry, Heat
from twin_core.parameters.parameter import Parameter

SHUT_QUANTILES = (0.05, 0.25, 0.5, 0.75)
"""Where among the visited temperatures the blades may begin to open."""
RANGES_K = (5.0, 15.0)
"""From shut to open: springs of real louvers need 10 to 18 K."""


@dataclass(frozen=True)
class LouverHeat:
    """q = sigma R s (T_s^4 - T^4), s = (T - T_shut) / range between 0 and 1; values are R, T_shut and range."""

    node: int
    sink: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the louver at all points at once, with its derivatives."""
        area_m2, shut_K, range_K = values
        temperature, sink = along.temperatures_K[:, self.node], along.boundaries_K[:, self.sink]
        bare = STEFAN_BOLTZMANN_W_PER_M2_K4 * (sink**4 - temperature**4)  # W/m2 of open radiator
        opening = (temperature - shut_K) / range_K
        share = np.clip(opening, 0.0, 1.0)
        moving = ((opening > 0.0) & (opening < 1.0)) / range_K  # d share / d T, 1/K
        by_temperature = area_m2 * (moving * bare - share * 4.0 * STEFAN_BOLTZMANN_W_PER_M2_K4 * temperature**3)
        by_sink = area_m2 * share * 4.0 * STEFAN_BOLTZMANN_W_PER_M2_K4 * sink**3
        return Heat(
            (self.node,),
            (area_m2 * share * bare)[:, None],
            by_temperature[:, None, None],
            [
                Entry(0, self.node, share * bare),
                Entry(1, self.node, -area_m2 * moving * bare),
                Entry(2, self.node, -area_m2 * moving * share * bare),
            ],
            [Entry(self.sink, self.node, by_sink)],
        )


class Louver(Effect):
    """A radiator whose effective area opens linearly between two blade temperatures."""

    name = "louver"
    keys = ("node", "sink")
    equation = "q = sigma R s (T_s^4 - T^4), s = (T - T_shut) / T_range, between 0 and 1"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 9 (louvers)"
    sentence = "a louver between {node} and {sink} was missing"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the effective area of the open louver, and the two blade temperatures as the lower one and a range."""
        return (
            ParameterSpec("R_m2", "m2", null=0.0, positive=True),
            ParameterSpec("T_shut_K", "K", prior_std=20.0, step_limit=5.0),
            ParameterSpec("T_range_K", "K", positive=True, prior_std=0.7),
        )

    def addition(self, layout: Layout) -> Addition:
        """Return the heat."""
        node, sink = layout.node(self.where["node"]), layout.boundary(self.where["sink"])
        return Addition((LouverHeat(node, sink, self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node with every boundary."""
        yield from ({"node": node, "sink": sink} for node in layout.declared_nodes for sink in layout.boundaries)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the null effect at blade temperatures among those that the node has visited."""
        for shut_K in np.quantile(survey.temperature_K(where["node"]), SHUT_QUANTILES).tolist():
            for range_K in RANGES_K:
                yield cls(where, {"R_m2": 0.0, "T_shut_K": shut_K, "T_range_K": range_K})
