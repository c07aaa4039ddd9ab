"""Held readings: repeats by which a table of rows fills the time until a sensor that is sampled more slowly reports again.

Each reading of such a sensor is one measurement, however many rows show it: counted row by row, its noise would be nothing
and the stairs would be heat. Two signs tell a held reading from a resting one. Either the channel changes on a regular grid of
rows and at no other, by more than a code of its converter; or its readings last about equally long although
it changes by many of its smallest steps at a time, so that no code could have kept it still.
"""

import numpy as np

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.quality.policy import LEAST_READINGS
from twin_core.quality.quantisation import resolution

REGULAR = 0.95
"""Share of the changes that keep to the grid, or of the readings that last equally long: the rest leaves room for rows that a
recorder lost. By chance, sixteen changes keep to every second row once in 65,000 channels."""

FINE = 3.0
"""A channel whose typical change is so many of its smallest ones resolves what it shows; from code to code it is one or two."""

LEAPING = 1.5
"""On a grid a mean change of so many of the smallest is enough: codes that a steady swing crosses are passed one by one."""


def held_repeats(time_s: FloatArray, column: FloatArray) -> BoolArray:
    """Return the repeats of readings that are held until the next one, (n_times,).

    Of a reading that lasts longer than the others do one repeat in each interval stays: it may be frozen.

    Parameters
    ----------
    time_s : (n_times,)
        Seconds, strictly increasing.
    column : (n_times,)
        Readings, NaN where missing.
    """
    found = np.zeros(column.size, dtype=np.bool_)
    at = np.flatnonzero(np.isfinite(column))
    if at.size < 2 * LEAST_READINGS:
        return found
    values, spacing_s = column[at], float(np.median(np.diff(time_s)))
    row = np.rint((time_s[at] - time_s[0]) / spacing_s).astype(np.int64)
    changes = np.flatnonzero(np.diff(values)) + 1
    finest = resolution(values)
    if changes.size < LEAST_READINGS or finest == 0.0:
        return found
    steps = np.abs(np.diff(values))[changes - 1] / finest
    beside = changes[row[changes] - row[changes - 1] == 1]  # behind a gap nobody knows when it changed
    period, phase = _grid(row[beside])
    if period > 1 and float(steps.mean()) >= LEAPING:
        found[at] = (row - phase) % period != 0
        # Where rows are lost the first one that shows a reading stands for it.
        found[at[changes]] = False
        found[at[0]] = False
        return found
    lasting = np.diff(changes)
    typical = float(np.median(lasting))
    is_regular = float(np.mean(np.abs(lasting - typical) <= 1.0)) >= REGULAR
    if typical >= 2.0 and is_regular and float(np.median(steps)) >= FINE:
        begins, every = np.concatenate([[0], changes]), np.arange(at.size)
        since = every - begins[np.searchsorted(changes, every, "right")]
        found[at] = since % (int(np.ceil(typical)) + 1) != 0
    return found


def _grid(row: IntArray) -> tuple[int, int]:
    """Return the longest period and the phase of the rows at which a channel changes; period 1 where there is none."""
    best = (1, 0)
    if row.size < LEAST_READINGS:
        return best
    for period in range(2, int(np.ptp(row)) // row.size + 2):
        counts = np.bincount(row % period, minlength=period)
        if counts.max() >= REGULAR * row.size:
            best = (period, int(counts.argmax()))
    return best
