"""An undeclared heat that sets in at an instant, and may end at another: a unit switched on, a new operating mode."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import ParameterSpec, Survey, Where
from twin_core.effects.onset import OnsetEffect
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Entry, Heat
from twin_core.parameters.parameter import Parameter

EVERY = 2
"""Of the instants at which a load may come on, one in so many is tried with one in so many ends: a limit of time."""


@dataclass(frozen=True)
class SteppedHeat:
    """q = Q times the share that has set in, less the share that has stopped; values are Q, time and, if it ends, stop."""

    node: int
    effect: "HeatLoadStep"
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the heat; a ramp as wide as a sampling interval stands for each step."""
        share, slope = self.effect.ramp(along.time_s, values[1])
        entries = [Entry(1, self.node, values[0] * slope)]
        if len(values) > 2:
            stopped, slope = self.effect.ramp(along.time_s, values[2])
            share = share - stopped
            entries.append(Entry(2, self.node, -values[0] * slope))
        entries.append(Entry(0, self.node, share))
        return Heat((self.node,), (values[0] * share)[:, None], np.zeros((1, 1, 1)), entries)


class HeatLoadStep(OnsetEffect):
    """q = Q from an instant on; with a value ``stop`` until that instant."""

    name = "heat_load_step"
    keys = ("node",)
    equation = "q = Q from time on, to stop if it ends"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 2 (dissipation by operating mode)"
    sentence = "a heat load that came on at {node} was missing"
    amplitude = ParameterSpec("Q_W", "W", null=0.0)

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return heat and onset, and the end where there is one."""
        amplitude, onset = super().parameter_specs()
        end = (replace(onset, name="stop"),) if "stop" in self.values else ()
        return (amplitude, onset, *end)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield loads that stay, and on a coarser grid loads that end: of one of these a load that stays may show nothing."""
        staying = list(super().starts(where, survey))
        yield from staying
        for begin, end in combinations(staying[::EVERY], 2):
            yield begin.with_values({"stop": end.values["time"]})

    def refined(self, survey: Survey) -> Iterable[Self]:
        """Yield onsets on both sides, before the end if there is one."""
        end = self.values.get("stop", np.inf)
        yield from (effect for effect in super().refined(survey) if effect.values["time"] < end)

    def completed(self, survey: Survey) -> Iterable[Self]:
        """Yield the load with an end, at the instants of ``starts`` after it came on."""
        if "stop" not in self.values:
            instants = (e.values["time"] for e in super().starts(self.where, survey))
            yield from (self.with_values({"stop": end}) for end in instants if end > self.values["time"])

    def addition(self, layout: Layout) -> Addition:
        """Return the heat."""
        term = SteppedHeat(layout.node(self.where["node"]), self, self.parameters())
        return Addition((term,), dated=self.settings["dated"])

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node."""
        yield from ({"node": node} for node in layout.declared_nodes)
