"""Declared conductors and radiators whose size changes: the declared heat times what the change makes of it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, Where
from twin_core.effects.missing_conductor import PairConductor
from twin_core.errors import ModelError
from twin_core.network.model import Layout, conductor_name, radiator_name
from twin_core.network.terms import Along, BoundaryConductor, Entry, Heat, SinkRadiation
from twin_core.parameters.parameter import Parameter

Change = Callable[[FloatArray, FloatArray], tuple[FloatArray, list[FloatArray]]]
"""(clock_s, values) -> factor less one, and its derivative by each value; all (n_points,)."""


@dataclass(frozen=True)
class Changed:
    """q = (factor - 1) * declared heat: what a changed conductor or radiator exchanges beyond its declaration.

    ``declared`` takes the one value that is borrowed: a conductance, or an exchange area.
    """

    declared: PairConductor | BoundaryConductor | SinkRadiation
    change: Change
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...]

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the change."""
        own = len(self.parameters)
        heat = self.declared.evaluate(along, values[own:])
        change, slopes = self.change(along.time_s, values[:own])
        entries = [
            Entry(i, node, slope * heat.heat_W[:, column])
            for i, slope in enumerate(slopes)
            for column, node in enumerate(heat.nodes)
        ]
        entries += [Entry(own + e.item, e.node, change * e.series) for e in heat.d_values]
        return Heat(
            heat.nodes,
            change[:, None] * heat.heat_W,
            change[:, None, None] * heat.d_temperature,
            entries,
            [Entry(e.item, e.node, change * e.series) for e in heat.d_boundaries],
        )


def conductor_places(layout: Layout) -> Iterable[Where]:
    """Yield every declared conductor; an end may be a boundary."""
    yield from ({"nodes": list(conductor.between)} for conductor in layout.spec.conductors if conductor.into is None)


def declared_conductor(effect: Effect, layout: Layout) -> tuple[PairConductor | BoundaryConductor, str]:
    """Return the conductor at the effect's place and the name of its conductance; ModelError if none is declared."""
    pair = frozenset(effect.where["nodes"])
    found = [c.between for c in layout.spec.conductors if frozenset(c.between) == pair and c.into is None]
    if not found:
        raise ModelError(f"effect {effect.name}: no declared conductor joins {' and '.join(effect.where['nodes'])}")
    between = found[0]
    outer = [end for end in between if end in layout.boundaries]
    if not outer:
        return PairConductor(layout.node(between[0]), layout.node(between[1]), ()), conductor_name(between)
    node = next(end for end in between if end not in outer)
    return BoundaryConductor(layout.node(node), layout.boundary(outer[0]), ()), conductor_name(between)


def radiator_places(layout: Layout) -> Iterable[Where]:
    """Yield every declared radiator."""
    yield from ({"node": radiator.node, "sink": radiator.sink} for radiator in layout.spec.radiators)


def declared_radiator(effect: Effect, layout: Layout) -> tuple[SinkRadiation, str]:
    """Return the radiator at the effect's place and the name of its area; ModelError if none is declared."""
    node, sink = effect.where["node"], effect.where["sink"]
    if effect.where not in list(radiator_places(layout)):
        raise ModelError(f"effect {effect.name}: no radiator from '{node}' to '{sink}' is declared")
    return SinkRadiation(layout.node(node), layout.boundary(sink), ()), radiator_name(node, sink)
