"""What of the archive is no reading: masked where the science reads it, told where an operator does, stored as it came."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from service.instants import format_instant
from service.live.engine import Engine
from service.store.samples import Samples
from service.twins.registry import Entry
from service.workbench.interface import Masks, Telemetry
from twin_core.quality.screen import SENTINEL, spans_of

CONTEXT = 256
"""So many samples before a block tell what its channels usually do."""

Json = dict[str, Any]


async def masks_of(twin: Entry, engine: Engine, found: Samples) -> Masks:
    """Return which samples of all channels of a twin, as stored, are no readings."""
    if not found.time_us.size:
        return {}
    values = {name: found.values[row] for row, name in enumerate(twin.channels)}
    inputs = [name for name in twin.channels if name not in twin.sensors]
    return await engine.screen(twin.units, inputs, Telemetry(int(found.time_us[0]), found.time_us, values))


async def readings(twin: Entry, engine: Engine, context: Samples | None, fresh: Samples) -> tuple[Samples, Samples]:
    """Return a block without samples that cannot be readings, and one that lacks only the markers of missing ones.

    The filter takes the first; the second shows a detector that a sensor stays away, or is stuck.

    Parameters
    ----------
    twin, engine
        Whose channels they are, and who looks.
    context
        What came right before; None where the block is the first one.
    fresh
        The block, all channels.
    """
    whole = fresh if context is None else _joined(context, fresh)
    clean, seen = fresh.values.copy(), fresh.values.copy()
    for name, reasons in (await masks_of(twin, engine, whole)).items():
        row = twin.channels.index(name)
        for reason, mask in reasons.items():
            in_block = mask[-fresh.time_us.size :]
            clean[row, in_block] = np.nan
            if reason == SENTINEL:
                seen[row, in_block] = np.nan
    return Samples(fresh.time_us, clean), Samples(fresh.time_us, seen)


def told(found: Samples, masks: Masks, names: Sequence[str], since_us: int) -> dict[str, list[Json]]:
    """Return the spans of each named channel that are no readings, with the reason, in order; from an instant on."""
    spans: dict[str, list[Json]] = defaultdict(list)
    for name, reasons in masks.items():
        if name not in names:
            continue
        for reason, mask in reasons.items():
            for first, stop in spans_of(reason, mask):
                if found.time_us[stop - 1] < since_us:
                    continue
                start, last = (format_instant(int(found.time_us[at])) for at in (first, stop - 1))
                samples = int(mask[first:stop].sum())
                spans[name].append({"start": start, "stop": last, "reason": reason, "samples": samples})
    return {name: sorted(rows, key=lambda row: str(row["start"])) for name, rows in spans.items()}


def _joined(one: Samples, other: Samples) -> Samples:
    return Samples(np.concatenate([one.time_us, other.time_us]), np.concatenate([one.values, other.values], axis=1))
