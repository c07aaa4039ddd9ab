"""Spikes: a few readings that are off what the neighbours on both sides allow, by more than this channel ever does.

From one side, a temperature may stay, or go on as it went, or be anywhere between: that holds for every relaxation, sampled
however slowly. A true peak lies where one of its two flanks leads; a spike lies where neither leads, and after it the record
goes on as if nothing had been. What else leaps, a heater that is switched or a panel that turns into the Sun between two
samples, shows how large a leap can be in this record: the steps by which readings depart from what one side allows. Their
upper tail is taken as exponential (heavier than a normal one), so by Renyi's theorem the gap between the largest step and one
that would be larger still is exponential too, with the tail's own mean: a leap is a spike only beyond a gap of the
probability that ``policy`` tolerates.
"""

import numpy as np

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.quality.policy import FALSE_ALARM_RATE, LEAST_READINGS, LONGEST_SPIKE
from twin_core.quality.quantisation import resolution

_PASSES = 3


def spikes(time_s: FloatArray, column: FloatArray) -> BoolArray:
    """Return which readings are spikes, (n_times,); never a missing one.

    Parameters
    ----------
    time_s : (n_times,)
        Seconds, strictly increasing.
    column : (n_times,)
        Readings, NaN where missing.
    """
    found = np.zeros(column.size, dtype=np.bool_)
    for _ in range(_PASSES):
        at = np.flatnonzero(np.isfinite(column) & ~found)
        if at.size < LEAST_READINGS:
            break
        more = _inner_spikes(time_s[at], column[at]) | _end_spikes(time_s[at], column[at])
        if not more.any():
            break
        found[at[more]] = True
    return found


def largest_step(time_s: FloatArray, values: FloatArray, besides: BoolArray | None = None) -> float:
    """Return how far a healthy reading may lie from what the readings on one side of it allow.

    Parameters
    ----------
    time_s, values : (n_readings,)
        Present readings only.
    besides : (n_readings,)
        Readings that are in question: neither they nor what they lead to are counted.
    """
    steps = _one_sided(time_s, values)
    if besides is not None and besides.any():
        near = besides.copy()
        for shift in (1, 2):
            near[shift:] |= besides[:-shift]
            near[:-shift] |= besides[shift:]
        steps = steps[~near]
    if steps.size < LEAST_READINGS:
        return float("inf")
    count = max(int(np.sqrt(steps.size)), LEAST_READINGS // 2)
    top = np.partition(steps, steps.size - count - 1)[steps.size - count - 1 :]
    tail = float(np.mean(top) - np.min(top)) * (count + 1) / count
    return float(np.max(top)) + tail * float(np.log(1.0 / FALSE_ALARM_RATE)) + resolution(values)


def _outside(value: FloatArray, *corners: FloatArray) -> FloatArray:
    """Return by how much a value lies above (positive) or below (negative) all corners, 0 between them."""
    high, low = corners[0], corners[0]
    for corner in corners[1:]:
        high, low = np.maximum(high, corner), np.minimum(low, corner)
    return np.maximum(value - high, 0.0) - np.maximum(low - value, 0.0)


def _one_sided(time_s: FloatArray, values: FloatArray) -> FloatArray:
    """Return the larger departure of each reading from what one of its sides allows, (n_readings,)."""
    slope = np.diff(values) / np.diff(time_s)
    forward, backward = np.zeros(values.size), np.zeros(values.size)
    ahead = values[1:-1] + slope[:-1] * np.diff(time_s)[1:]
    forward[2:] = np.abs(_outside(values[2:], values[1:-1], ahead))
    behind = values[1:-1] - slope[1:] * np.diff(time_s)[:-1]
    backward[:-2] = np.abs(_outside(values[:-2], values[1:-1], behind))
    return np.maximum(forward, backward)


def _inner_spikes(time_s: FloatArray, values: FloatArray) -> BoolArray:
    """Return spikes that have two readings on either side."""
    excursions = [_excursion(time_s, values, length) for length in range(1, LONGEST_SPIKE + 1)]
    doubtful = _spread(excursions, 4.0 * float(np.quantile(_one_sided(time_s, values), 0.9)), values.size)
    while doubtful.any():
        found = _spread(excursions, largest_step(time_s, values, doubtful), values.size)
        if (found == doubtful).all():
            break
        doubtful = found & doubtful
    return doubtful


def _excursion(time_s: FloatArray, values: FloatArray, length: int) -> tuple[FloatArray, FloatArray]:
    """Return height and trace of every run of ``length`` readings that starts at index 2 or later, (n_runs,) each.

    The height is the least distance of its readings from everything that both sides allow; the trace is how far the first
    reading after the run is from what those before it allow, and the other way round: true heat leaves one. A line through two
    readings with white noise of variance 1 misses a third, ``reach`` intervals on, by 1 + (1 + reach)² + reach²: the trace counts
    as if it had to reach one interval, as the steps with which it is compared do.
    """
    count = values.size - length - 3
    if count <= 0:
        return np.zeros(0), np.zeros(0)
    at = np.arange(2, 2 + count)
    slope = np.diff(values) / np.diff(time_s)
    before, after = at - 1, at + length
    left, right = slope[at - 2], slope[after]
    height: FloatArray | None = None
    for inside in range(length):
        now = time_s[at + inside]
        ahead = values[before] + left * (now - time_s[before])
        behind = values[after] + right * (now - time_s[after])
        off = _outside(values[at + inside], values[before], values[after], ahead, behind)
        if height is None:
            height = off
        else:
            height = np.where(
                np.sign(height) == np.sign(off), np.sign(off) * np.minimum(np.abs(height), np.abs(off)), 0.0
            )
    assert height is not None
    gap_s = time_s[after] - time_s[before]
    after_before = np.abs(_outside(values[after], values[before], values[before] + left * gap_s))
    before_after = np.abs(_outside(values[before], values[after], values[after] - right * gap_s))
    reach = length + 1
    wider = np.sqrt((1.0 + (1.0 + reach) ** 2 + reach**2) / 6.0)
    return np.abs(height), np.minimum(after_before, before_after) / wider


def _spread(excursions: list[tuple[FloatArray, FloatArray]], bound: float, size: int) -> BoolArray:
    """Return the readings of all excursions that are higher than a bound and leave no trace beyond it, (size,)."""
    found = np.zeros(size, dtype=np.bool_)
    for length, (height, trace) in enumerate(excursions, start=1):
        starts: IntArray = np.flatnonzero((height > bound) & (trace <= bound)) + 2
        for inside in range(length):
            found[starts + inside] = True
    return found


def _end_spikes(time_s: FloatArray, values: FloatArray) -> BoolArray:
    """Return readings at either end of the record that lie farther from the rest than the rest spans.

    Only one side speaks there, so that a fast transient cannot be told from a spike by its speed; but a transient goes on.
    """
    found = np.zeros(values.size, dtype=np.bool_)
    for length in range(1, LONGEST_SPIKE + 1):
        for ends, rest in ((slice(0, length), slice(length, None)), (slice(-length, None), slice(None, -length))):
            others = values[rest]
            span = float(np.ptp(others))
            off = np.abs(values[ends] - np.clip(values[ends], np.min(others), np.max(others)))
            if float(off.min()) <= span:
                continue
            bound = largest_step(time_s[rest], others)
            if float(off.min()) > span + bound and np.ptp(values[ends]) <= bound:
                found[ends] = True
    return found
