"""What input effects share: the declared loads of a channel as terms to be corrected."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, Where
from twin_core.errors import ModelError
from twin_core.network.model import Addition, Layout, gain_name
from twin_core.network.terms import Along, ChannelLoad, Entry, Heat
from twin_core.parameters.parameter import Parameter

Shape = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, list[FloatArray]]]
"""(declared u, clock_s, values) -> correction of u, and its derivative by each value; all (n_points,)."""


@dataclass(frozen=True)
class InputCorrection:
    """q = gain * weight * correction(u): what is delivered beyond the declared heat of one load."""

    load: ChannelLoad
    shape: Shape
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...]

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the correction; the load's own gain is borrowed."""
        own, gain = values[:-1], values[-1]
        declared = along.inputs[self.load.channel]
        correction, slopes = self.shape(declared, along.time_s, own)
        factor = self.load.weight * (along.sun_factor if self.load.solar else np.ones_like(declared))
        node = self.load.node
        entries = [Entry(i, node, gain * factor * slope) for i, slope in enumerate(slopes)]
        entries.append(Entry(len(own), node, factor * correction))
        return Heat((node,), (gain * factor * correction)[:, None], np.zeros((1, 1, 1)), entries)


def correct_channel(effect: Effect, layout: Layout, shape: Shape, dated: bool | None = None) -> Addition:
    """Return one correction per declared load of the effect's channel; ModelError if it drives none."""
    loads = [load for load in layout.loads_of(effect.where["channel"]) if load.table is None]
    if not loads:
        raise ModelError(f"effect {effect.name}: channel '{effect.where['channel']}' drives no declared load")
    return Addition(
        tuple(
            InputCorrection(
                ChannelLoad(layout.node(load.node), load.channel, load.weight, load.solar, ()),
                shape,
                effect.parameters(),
                (gain_name(load),),
            )
            for load in loads
        ),
        dated=dated,
    )


def driving_channels(layout: Layout) -> Iterable[Where]:
    """Yield every channel that drives a declared load other than a table."""
    yield from ({"channel": name} for name in layout.spec.inputs if any(x.table is None for x in layout.loads_of(name)))


def gain_is_known(layout: Layout, channel: str) -> bool:
    """Return whether a channel's declared loads all have a known gain."""
    kinds = [
        (load.gain is None and layout.spec.inputs[channel].unit == "W") or (load.gain and load.gain.value is not None)
        for load in layout.loads_of(channel)
        if load.table is None
    ]
    return bool(kinds) and all(kinds)
