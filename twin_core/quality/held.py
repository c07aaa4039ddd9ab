"""Held readings: repeats by which a table of rows fills the time until a sensor reports again.

A sensor may be sampled more slowly than the rows are written, or report a change only. Each of its readings is one
measurement, however many rows show it: counted row by row, its noise would be nothing and the stairs would be heat. A channel
that resolves far less than its typical change cannot repeat a reading by itself: something held it.
"""

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.quality.policy import LEAST_READINGS

FINE = 3.0
"""Typical change over the smallest distance between two readings, above which repeats are held: from code to code of a
converter it is one or two. Of 600 channels of coarse, uneven converters 291 were taken for held without it, 94 at half of it,
none at it and at twice; of 600 held ones all were found each time."""

SMALLEST = 0.02
"""Quantile that stands for the smallest distance."""


def held_repeats(column: FloatArray) -> BoolArray:
    """Return the repeats of readings that are held until the next one, (n_times,); of healthy channels none.

    Of a reading that lasts longer than the longest of so many would one repeat in each such time stays: it may be frozen.

    Parameters
    ----------
    column : (n_times,)
        Readings, NaN where missing.
    """
    found = np.zeros(column.size, dtype=np.bool_)
    at = np.flatnonzero(np.isfinite(column))
    values, every = column[at], np.arange(at.size)
    changes = np.flatnonzero(np.diff(values)) + 1
    if changes.size < LEAST_READINGS:
        return found
    lasting = np.diff(changes)
    halves = np.array_split(values[changes], 2 if SMALLEST * changes.size > 2.0 else 1)
    finest = max(_finest(half) for half in halves)
    typical = np.median(np.abs(np.diff(values))[changes - 1])
    if np.median(lasting) < 2.0 or typical < FINE * finest:
        return found
    begins = np.concatenate([[0], changes])
    since = every - begins[np.searchsorted(changes, every, "right")]
    # Reports at random last exponentially long: the longest of n is log n times the mean, the median log 2 times.
    longest = np.median(lasting) * np.log2(changes.size)
    found[at] = since % int(np.ceil(longest)) != 0
    return found


def _finest(readings: FloatArray) -> float:
    """Return the smallest distance between two readings: an offset that sets in once shows in one half of a record only."""
    return float(np.quantile(np.diff(np.unique(readings)), SMALLEST))
