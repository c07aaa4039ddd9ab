"""Heat that follows an auxiliary channel: attitude-steered sunlight, an instrument mode, a table position."""

from collections.abc import Iterable
from typing import Self

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.effects.base import Effect, Quality, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.orbit_block import PREFIX
from twin_core.network.spec import Load
from twin_core.network.terms import SteeredTable, TableLoad, nearest
from twin_core.orbit.environment import BETA

N_KNOTS = 6
MIN_SHARE = 0.02
"""An inner knot needs this share of the samples near it, or its value would be a guess."""

N_PARTS, MIN_PARTS = 8, 2
"""What a state does at a knot must be seen in so many parts of the record: only what repeats can be told from chance."""


def even_knots(series: FloatArray) -> tuple[float, ...]:
    """Return knots spread evenly over the visited range, ends included, without those that few samples are near."""
    knots = np.linspace(float(series.min()), float(series.max()), N_KNOTS)
    kept = np.bincount(nearest(series, knots.tolist()), minlength=N_KNOTS) > MIN_SHARE * series.size
    kept[[0, -1]] = True
    return tuple(float(k) for k in knots[kept])


def revisited(at: BoolArray, n_least: float) -> bool:
    """Return whether points (n_points,) are at least so many, in several parts of the record."""
    counts = np.array([part.sum() for part in np.array_split(at, N_PARTS)])
    return bool(counts.sum() > n_least and (counts > n_least / N_PARTS).sum() >= MIN_PARTS)


class ChannelHeatLoad(Effect):
    """q = f(x): piecewise linear over knots, or one value per level; or per level another table of a declared channel.

    The latter is what a commanded state does that shades or exposes parts: what attitude brings in differs from state to
    state. The declared table tells it for the state that is visited most, the effect how the others differ from that.
    """

    name = "channel_heat_load"
    keys = ("node", "channel")
    equation = "q = f(x)"
    reference = (
        "Solar heat by pitch and instrument position in the Chandra thermal models (Aldcroft, Xija documentation)"
    )
    sentence = "a heat load on {node} that depends on {channel} was missing"
    reported_settings = ("knots", "states", "across")

    def qualities(self) -> tuple[Quality, ...]:
        """Return the heat at each knot."""
        return tuple(Quality(f"values_W[{i}]", "W", null=0.0) for i in range(len(self.settings["knots"])))

    def addition(self, layout: Layout) -> Addition:
        """Return the table."""
        own, node, channel = self.settings, layout.node(self.where["node"]), self.where["channel"]
        knots, parameters = tuple(own["knots"]), self.parameters()
        if "across" not in own:
            return Addition((TableLoad(node, channel, knots, bool(own["levels"]), 1.0, False, parameters),))
        solar, states, rests = bool(own["solar"]), tuple(own["states"]), tuple(own["levels"])
        table = SteeredTable(
            node, own["across"], knots, False, 1.0, solar, parameters, (), None, states, channel, rests
        )
        return Addition((table,))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node with every auxiliary channel, but where a table of that channel is declared.

        Not the parts of a quaternion, which mean nothing one by one, nor the orbit's angle to the Sun, which moves so
        slowly that it would explain any drift; nor what a formula gives, whose channels stand for themselves.
        """
        mute = {f"{PREFIX}{BETA}", *layout.spec.attitude_channels, *layout.spec.derived}
        declared = {(load.channel, load.node) for load in layout.spec.loads if load.table is not None}
        auxiliary = [name for name, c in layout.spec.inputs.items() if c.kind == "auxiliary" and name not in mute]
        for node in layout.declared_nodes:
            for channel in auxiliary:
                if (channel, node) not in declared:
                    yield {"node": node, "channel": channel}

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield a table over the levels that the channel takes, or over its quantiles; and what a level does to others."""
        name = where["channel"]
        if name not in survey.along.inputs:
            return
        series = survey.along.inputs[name]
        levels = survey.layout.spec.inputs[name].levels or np.unique(series).size <= 6
        knots = survey.channel_levels.get(name) or tuple(np.unique(series))
        if not levels:
            knots = even_knots(series)
        if len(knots) < 2:
            return
        yield cls._null(where, {"knots": knots, "levels": bool(levels)})
        for load in survey.layout.spec.loads if levels else ():
            if load.table is not None and load.table.knots and load.channel in survey.along.inputs:
                yield from cls._steered(where, knots, load, survey)

    @classmethod
    def _steered(cls, where: Where, levels: tuple[float, ...], load: Load, survey: Survey) -> Iterable[Self]:
        """Yield how a declared table differs between states, at the knots to which each state has come again and again."""
        assert load.table is not None and load.table.knots is not None
        knots = load.table.knots
        state = nearest(survey.along.inputs[where["channel"]], levels)
        knot = nearest(survey.along.inputs[load.channel], knots)
        reference = int(np.bincount(state, minlength=len(levels)).argmax())
        n_least = MIN_SHARE / len(levels) * state.size
        cells = [
            (level, at)
            for k, level in enumerate(levels)
            for i, at in enumerate(knots)
            if k != reference and revisited((state == k) & (knot == i), n_least)
        ]
        states, at = tuple(level for level, _ in cells), tuple(knot for _, knot in cells)
        if len(at) > len(set(states)):  # a state with a single knot is a level
            settings = {"knots": at, "states": states, "across": load.channel, "levels": levels, "solar": load.solar}
            yield cls._null(where, settings)

    @classmethod
    def _null(cls, where: Where, settings: dict[str, object]) -> Self:
        """Return the effect at no heat."""
        knots = settings["knots"]
        assert isinstance(knots, tuple)
        return cls(where, {f"values_W[{i}]": 0.0 for i in range(len(knots))}, settings)
