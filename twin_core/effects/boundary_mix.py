"""A sink that is only in part what its channel reads: the rest is a surface of constant temperature that nobody reads."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.boundaries import boundary_places, changed_boundary, heat_of_change
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Sink
from twin_core.parameters.parameter import Parameter

HOTTEST_K = 5000.0
"""As in the specification: no sink is hotter."""


@dataclass(frozen=True)
class Mix:
    """T -> alpha T + (1 - alpha) T_w; values are alpha and T_w."""

    boundary: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()
    rank: int = 1

    def evaluate(self, given_K: FloatArray, along: Along, values: FloatArray) -> Sink:
        """Evaluate the mixture."""
        alpha, wall_K = values
        one = np.ones(given_K.size)
        return Sink(
            alpha * given_K + (1.0 - alpha) * wall_K, alpha * one, [(0, given_K - wall_K), (1, (1.0 - alpha) * one)]
        )


class BoundaryMix(Effect):
    """The sink is alpha T_s + (1 - alpha) T_w; with alpha = 0 the channel is not the sink at all."""

    name = "boundary_mix"
    keys = ("boundary",)
    equation = "sink = alpha T_s + (1 - alpha) T_w"
    reference = "ECSS-E-HB-31-03A, Thermal analysis handbook (effective sink temperatures)"
    sentence = "the temperature of {boundary} follows its channel only in part"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the share of the channel, and the temperature of the rest, which any value stands for without it."""
        return (
            ParameterSpec("alpha", "", null=1.0, lower=0.0, upper=1.0),
            ParameterSpec(
                "T_w_K", "K", null=self.settings.get("T_ref_K", self.values["T_w_K"]), prior_std=50.0, lower=0.0
            ),
        )

    def addition(self, layout: Layout) -> Addition:
        """Return the change of the boundary."""
        return Addition(boundaries=(Mix(changed_boundary(self, layout, constant=False), self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every boundary that a channel tells."""
        yield from boundary_places(layout, constant=False)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect, about the mean of the channel; none where it rests and an offset says the same."""
        given_K = survey.declared_boundary_K(where["boundary"])
        if np.ptp(given_K) > 0.0:
            mean_K = float(given_K.mean())
            yield cls(where, {"alpha": 1.0, "T_w_K": mean_K}, {"T_ref_K": mean_K})

    def unit_heats(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return the heat per unit of what the channel loses, and per kelvin by which that moves the sink.

        With u = 1 - alpha and v = u (T_w - T_ref) the sink is T_s + u (T_ref - T_s) + v: linear in both, for all alpha.
        """
        given_K, name = survey.declared_boundary_K(self.where["boundary"]), self.where["boundary"]
        swing = self.settings["T_ref_K"] - given_K
        return [heat_of_change(survey, name, change) for change in (swing, np.ones(given_K.size))]

    def with_amplitudes(self, amounts: FloatArray) -> Self | None:
        """Return the effect whose channel has lost a share u and whose sink has moved by v; None if u is not positive."""
        lost, moved_K = float(amounts[0]), float(amounts[1])
        if lost <= 0.0:
            return None
        lost = min(lost, 1.0)
        wall_K = self.settings["T_ref_K"] + moved_K / lost
        return self.with_values({"alpha": 1.0 - lost, "T_w_K": wall_K}) if 0.0 <= wall_K <= HOTTEST_K else None
