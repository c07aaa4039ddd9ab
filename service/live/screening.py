"""What of the archive is no reading: masked where the science reads it, told where an operator does, stored as it came."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from service.instants import format_instant
from service.registry import Entry
from service.store.samples import Samples
from twin_core.quality import Screening, screen
from twin_core.quality.runs import runs_of
from twin_core.units import to_si

CONTEXT = 256
"""So many samples before a block tell what its channels usually do."""

Json = dict[str, Any]


def screening(twin: Entry, found: Samples) -> Screening:
    """Return which samples of all channels of a twin, as stored, are no readings."""
    if not found.time_us.size:
        return Screening({})
    columns = {name: to_si(found.values[row], twin.units[name]) for row, name in enumerate(twin.channels)}
    return screen((found.time_us - found.time_us[0]) / 1e6, columns, twin.units)


def readings(twin: Entry, context: Samples | None, fresh: Samples) -> Samples:
    """Return a block without samples that cannot be readings.

    Parameters
    ----------
    twin
        Whose channels they are.
    context
        What came right before; None where the block is the first one.
    fresh
        The block, all channels.
    """
    whole = fresh if context is None else _joined(context, fresh)
    values = fresh.values.copy()
    for name, reasons in screening(twin, whole).masks.items():
        row = twin.channels.index(name)
        for mask in reasons.values():
            values[row, mask[-fresh.time_us.size :]] = np.nan
    return Samples(fresh.time_us, values)


def told(twin: Entry, found: Samples, names: Sequence[str]) -> dict[str, list[Json]]:
    """Return the spans of each named channel that are no readings, with the reason, in the order of time."""
    spans: dict[str, list[Json]] = defaultdict(list)
    for name, reasons in screening(twin, found).masks.items():
        if name not in names:
            continue
        for reason, mask in reasons.items():
            for first, stop in zip(*(ends.tolist() for ends in runs_of(mask)), strict=True):
                start, last = (format_instant(int(found.time_us[at])) for at in (first, stop - 1))
                spans[name].append({"start": start, "stop": last, "reason": reason, "samples": stop - first})
    return {name: sorted(rows, key=lambda row: str(row["start"])) for name, rows in spans.items()}


def _joined(one: Samples, other: Samples) -> Samples:
    return Samples(np.concatenate([one.time_us, other.time_us]), np.concatenate([one.values, other.values], axis=1))
