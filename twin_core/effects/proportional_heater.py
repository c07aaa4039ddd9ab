"""An undeclared proportional heater: heat in proportion to how far a node is below a set-point, up to its power."""

from collections.abc import Iterable
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import ProportionalHeat

SET_POINT_QUANTILES = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 1.0)
SATURATED_SHARES = (0.0, 0.3, 0.6)
"""Share of the heated time at full power that a starting point assumes."""


class ProportionalHeater(Effect):
    """q = min(Q, k (T_set - T)) below T_set, else 0."""

    name = "proportional_heater"
    keys = ("node",)
    equation = "q = min(Q, k (T_set - T)) below T_set, else 0"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 7"
    sentence = "a proportionally controlled heater on {node} was missing"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return gain, set-point and power limit."""
        return (
            ParameterSpec("k_W_per_K", "W/K", null=0.0, positive=True),
            ParameterSpec("T_set_K", "K", lower=0.0),
            ParameterSpec("Q_W", "W", positive=True, prior_std=3.0, open_ended=True),
        )

    def addition(self, layout: Layout) -> Addition:
        """Return the heater."""
        return Addition((ProportionalHeat(layout.node(self.where["node"]), self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node."""
        yield from ({"node": node} for node in layout.declared_nodes)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield set-points over the visited range, with the heater saturated for part of the time below them."""
        temperature = survey.temperature_K(where["node"])
        for quantile in SET_POINT_QUANTILES:
            set_point = float(np.quantile(temperature, quantile))
            below = set_point - temperature[temperature < set_point]
            if below.size < 10 or below.max() < 0.2:
                continue
            for share in SATURATED_SHARES:
                reach = float(np.quantile(below, 1.0 - share)) * (1.2 if share == 0.0 else 1.0)
                yield cls(where, {"k_W_per_K": 0.0, "T_set_K": set_point, "Q_W": 1.0}, {"reach_K": reach})

    def unit_heats(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return the heat per unit of gain of a heater that is at full power ``reach_K`` below its set-point."""
        node = self.where["node"]
        below = np.clip(self.values["T_set_K"] - survey.temperature_K(node), 0.0, self.settings["reach_K"])
        return [[(survey.layout.node(node), below)]]

    def with_amplitudes(self, amounts: FloatArray) -> "ProportionalHeater | None":
        """Return the heater with its power limit at ``reach_K`` below the set-point."""
        moved = super().with_amplitudes(amounts)
        if moved is None:
            return None
        return moved.with_values({"Q_W": moved.values["k_W_per_K"] * self.settings["reach_K"]})
