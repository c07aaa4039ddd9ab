"""A declared conductor that conducts better or worse where it is warm: a cryogenic strap, a gap filler, a heat pipe."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.declared import conductor_places, declared_conductor
from twin_core.effects.missing_conductor import PairConductor
from twin_core.effects.straight_line import range_of_slope, slope_spec
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, BoundaryConductor, Entry, Heat, pair_jacobian
from twin_core.parameters.parameter import Parameter


def end_temperatures_K(conductor: PairConductor | BoundaryConductor, along: Along) -> tuple[FloatArray, FloatArray]:
    """Return the temperatures of both ends, (n_points,) each."""
    if isinstance(conductor, PairConductor):
        return along.temperatures_K[:, conductor.first], along.temperatures_K[:, conductor.second]
    return along.temperatures_K[:, conductor.node], along.boundaries_K[:, conductor.boundary]


@dataclass(frozen=True)
class WarmConductor:
    """q_a = -q_b = G max(beta (T_mean - T_ref), -1) (T_b - T_a): what comes on top of the declared conductor.

    The bound keeps the conductance from turning negative beyond the temperatures that calibrated it.
    """

    conductor: PairConductor | BoundaryConductor
    reference_K: float
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...]

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the exchange; the conductance is borrowed."""
        (beta, conductance), (first, second) = values, end_temperatures_K(self.conductor, along)
        difference, warmth = second - first, 0.5 * (first + second) - self.reference_K
        conducting = beta * warmth > -1.0
        change = np.maximum(beta * warmth, -1.0)
        heat, bend = conductance * change * difference, np.where(conducting, 0.5 * beta * difference, 0.0)
        d_first, d_second = conductance * (bend - change), conductance * (bend + change)
        by_value = (np.where(conducting, conductance * warmth * difference, 0.0), change * difference)
        if isinstance(self.conductor, BoundaryConductor):
            node = self.conductor.node
            entries = [Entry(i, node, series) for i, series in enumerate(by_value)]
            outer = [Entry(self.conductor.boundary, node, d_second)]
            return Heat((node,), heat[:, None], d_first[:, None, None], entries, outer)
        nodes = (self.conductor.first, self.conductor.second)
        entries = [
            Entry(i, node, sign * series)
            for i, series in enumerate(by_value)
            for node, sign in zip(nodes, (1.0, -1.0), strict=True)
        ]
        return Heat(nodes, np.stack([heat, -heat], axis=1), pair_jacobian(d_first, d_second), entries)


class ConductanceTemperature(Effect):
    """G -> G (1 + beta (T_mean - T_ref)), never less than nothing."""

    name = "conductance_temperature"
    keys = ("nodes",)
    equation = "q_a = -q_b = G max(1 + beta (T_mean - T_ref), 0) (T_b - T_a)"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 8; Incropera, Heat and Mass Transfer, 2.2"
    sentence = "the conductance between {first} and {second} depends on temperature"
    reported_settings = ("T_ref_K",)

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the temperature coefficient."""
        return (slope_spec("beta_per_K", self.settings),)

    def addition(self, layout: Layout) -> Addition:
        """Return the change of the declared conductor."""
        conductor, name = declared_conductor(self, layout)
        return Addition((WarmConductor(conductor, self.settings["T_ref_K"], self.parameters(), (name,)),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every declared conductor."""
        yield from conductor_places(layout)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the null effect about the mean temperature of the pair: it is linear in beta."""
        blank = cls(where, {"beta_per_K": 0.0}, {"T_ref_K": 0.0})
        ends = end_temperatures_K(declared_conductor(blank, survey.layout)[0], survey.along)
        mean_K = 0.5 * (ends[0] + ends[1])
        reference_K = float(mean_K.mean())
        yield cls(where, blank.values, {"T_ref_K": reference_K, **range_of_slope(mean_K, reference_K)})
