"""A sink that is warmer or colder than what was declared for it: a sensor in the wrong place, heat that stays in a room."""

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


@dataclass(frozen=True)
class Offset:
    """T -> T + b."""

    boundary: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()
    rank: int = 1

    def evaluate(self, given_K: FloatArray, along: Along, values: FloatArray) -> Sink:
        """Evaluate the offset."""
        one = np.ones(given_K.size)
        return Sink(given_K + values[0], one, [(0, one)])


class BoundaryOffset(Effect):
    """The sink is T_s + b, not T_s."""

    name = "boundary_offset"
    keys = ("boundary",)
    equation = "sink = T_s + b"
    reference = "ECSS-E-HB-31-03A, Thermal analysis handbook (boundary conditions of test correlation)"
    sentence = "the temperature of {boundary} is offset from its declared value"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the offset; a known constant cannot fall below absolute zero."""
        return (ParameterSpec("b_K", "K", null=0.0, prior_std=50.0, lower=self.settings.get("least_K")),)

    def addition(self, layout: Layout) -> Addition:
        """Return the change of the boundary."""
        boundary = changed_boundary(self, layout, constant=True)
        return Addition(boundaries=(Offset(boundary, self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every boundary that is not an unknown constant anyway."""
        yield from boundary_places(layout, constant=True)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the one null effect."""
        constant_K = survey.layout.spec.boundaries[where["boundary"]].value_K
        yield cls(where, {"b_K": 0.0}, {} if constant_K is None else {"least_K": -constant_K})

    def unit_heats(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return the heat per kelvin of offset."""
        return [heat_of_change(survey, self.where["boundary"], np.ones(survey.along.time_s.size))]
