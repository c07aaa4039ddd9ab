"""Heat that follows an auxiliary channel: attitude-steered sunlight, an instrument mode, a table position."""

from collections.abc import Iterable
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, Quality, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import TableLoad

N_KNOTS = 6
MIN_SHARE = 0.02
"""An inner knot needs this share of the samples near it, or its value would be a guess."""


def even_knots(series: FloatArray) -> tuple[float, ...]:
    """Return knots spread evenly over the visited range, ends included, without those that few samples are near."""
    knots = np.linspace(float(series.min()), float(series.max()), N_KNOTS)
    nearest = np.argmin(np.abs(series[:, None] - knots), axis=1)
    share = np.bincount(nearest, minlength=N_KNOTS) / series.size
    kept = share > MIN_SHARE
    kept[[0, -1]] = True
    return tuple(float(k) for k in knots[kept])


class ChannelHeatLoad(Effect):
    """q = f(x): piecewise linear over knots, or one value per level."""

    name = "channel_heat_load"
    keys = ("node", "channel")
    equation = "q = f(x)"
    reference = "Solar heat by pitch in the Chandra thermal models (Aldcroft, Xija documentation)"
    words = "receives heat that follows {channel}"
    reported_settings = ("knots",)

    def qualities(self) -> tuple[Quality, ...]:
        """Return the heat at each knot."""
        return tuple(Quality(f"values_W[{i}]", "W", null=0.0) for i in range(len(self.settings["knots"])))

    def addition(self, layout: Layout) -> Addition:
        """Return the table."""
        knots, levels = tuple(self.settings["knots"]), bool(self.settings["levels"])
        node = layout.node(self.where["node"])
        return Addition((TableLoad(node, self.where["channel"], knots, levels, 1.0, False, self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node with every auxiliary channel, but where a table of that channel is declared."""
        declared = {(load.channel, load.node) for load in layout.spec.loads if load.table is not None}
        auxiliary = [name for name, channel in layout.spec.channels.items() if channel.kind == "auxiliary"]
        for node in layout.declared_nodes:
            for channel in auxiliary:
                if (channel, node) not in declared:
                    yield {"node": node, "channel": channel}

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield a table over the levels that the channel takes, or over its quantiles."""
        name = where["channel"]
        if name not in survey.along.inputs:
            return
        series = survey.along.inputs[name]
        levels = survey.layout.spec.channels[name].levels or np.unique(series).size <= 6
        knots = survey.channel_levels.get(name) or tuple(np.unique(series))
        if not levels:
            knots = even_knots(series)
        if len(knots) >= 2:
            values = {f"values_W[{i}]": 0.0 for i in range(len(knots))}
            yield cls(where, values, {"knots": knots, "levels": bool(levels)})
