"""Frozen readings: a value that is repeated for longer than quantisation and rate of change explain.

A reading stays the same where the truth stays within one quantisation step. How probable that is from one sample to the
next is told by the readings just before and just after: by how far they move beyond what quantisation alone can show, and
by how often they repeat themselves. A run of n repeats has the n-th power of that probability. The quieter side counts, so
that a rest that something ends, or that something led to, is no freeze. Near a turning point of a smooth signal, a run of n
repeats has neighbours that move by less than one step per sample, so no turning point is taken for a freeze; nor does one end
in a leap. Where the leap at the end of a run is more than all moves beside it, the truth went on unseen, as fast as both sides.
"""

import math
from collections.abc import Sequence

import numpy as np

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.quality.policy import FALSE_ALARM_RATE, LEAST_READINGS, LONGEST_SPIKE
from twin_core.quality.quantisation import resolution
from twin_core.quality.runs import runs_of

_LEAST_WINDOW, _LARGEST_WINDOW = 8, 64
LEAST_MOVING = 2
"""Moving channels that are read in a frozen row: where it is one alone the channel may be frozen, and a command may rest."""
_erf = np.frompyfunc(math.erf, 1, 1)  # a service that starts needs no SciPy


def frozen_rows(columns: Sequence[FloatArray]) -> BoolArray:
    """Return the rows that repeat all readings of the row before, in runs that chance does not explain, (n_times,).

    Parameters
    ----------
    columns : n_channels of (n_times,)
        Readings, NaN where missing; a channel without readings in a row has no say there.
    """
    n_times = columns[0].size if columns else 0
    found = np.zeros(n_times, dtype=np.bool_)
    moving = [column for column in columns if resolution(column) > 0.0]
    if n_times < LEAST_READINGS or len(moving) < LEAST_MOVING:
        return found
    same = np.ones(n_times - 1, dtype=np.bool_)
    for column in columns:
        same &= (column[1:] == column[:-1]) | (np.isnan(column[1:]) & np.isnan(column[:-1]))
    same &= np.sum([np.isfinite(column[1:]) for column in moving], axis=0) >= LEAST_MOVING
    first, stop = runs_of(same)
    stay = np.maximum(same.mean(), np.prod([_stay(column, first, stop) for column in moving], axis=0))
    _mark(found, first, stop, _unlikely(stop - first, stay, n_times))
    return found


def frozen_channel(column: FloatArray) -> BoolArray:
    """Return the readings of one channel that are frozen repeats of an earlier one, (n_times,).

    Parameters
    ----------
    column : (n_times,)
        Readings, NaN where missing.
    """
    found = np.zeros(column.size, dtype=np.bool_)
    at = np.flatnonzero(np.isfinite(column))
    values = column[at]
    if at.size < LEAST_READINGS or resolution(values) == 0.0:
        return found
    same = values[1:] == values[:-1]
    first, stop = runs_of(same)
    stay = np.maximum(same.mean(), _stay(values, first, stop))
    doubtful = _unlikely(stop - first, np.full(first.size, same.mean()), 1) & (stay < 1.0)
    stay = np.maximum(stay, _sticky(values, first, stop, doubtful))
    of_present = np.zeros(at.size, dtype=np.bool_)
    _mark(of_present, first, stop, _unlikely(stop - first, stay, at.size))
    found[at[of_present]] = True
    return found


def _sticky(values: FloatArray, first: IntArray, stop: IntArray, doubtful: BoolArray) -> FloatArray:
    """Return how probable a repeat is as the channel's wide codes tell it, (n_runs,); 0 where it has none.

    Some codes of a converter are far wider than others: what stays long at one value again and again is no freeze. Such a value
    is known by two runs that, each taken alone, are longer than the record's share of repeats explains. One wide code tells of
    others, that a short record shows once. The longest of n runs has about log(n + 1) times the mean length, so it tells the
    probability, whatever the short ones do. At the ends of the range it may be a rail, which repeats too.
    """
    _, code = np.unique(values[first], return_inverse=True)
    inner = (values[first] > values.min()) & (values[first] < values.max())
    wide = inner & (np.bincount(code, doubtful)[code] > 1.0)
    length = np.where(wide, stop - first, 0).astype(np.float64)
    second, longest = np.sort(np.concatenate([[0.0, 0.0], length]))[-2:]
    rival = np.where(length == longest, second, longest)
    return np.where(inner & (rival > 0.0), np.exp(-np.log(wide.sum() - wide + 1.0) / np.maximum(rival, 1.0)), 0.0)


def _unlikely(repeats: IntArray, stay: FloatArray, n_times: int) -> BoolArray:
    """Return which runs are longer than chance allows anywhere in the record."""
    with np.errstate(divide="ignore"):
        log_probability = repeats * np.log(stay) + np.log(n_times)
    unlikely: BoolArray = log_probability < np.log(FALSE_ALARM_RATE)
    return unlikely


def _mark(found: BoolArray, first: IntArray, stop: IntArray, unlikely: BoolArray) -> None:
    for begin, end in zip(first[unlikely].tolist(), stop[unlikely].tolist(), strict=True):
        found[begin + 1 : end + 1] = True


def _stay(column: FloatArray, first: IntArray, stop: IntArray) -> FloatArray:
    """Return how probable it is, beside each run, that a reading is that of the sample before, (n_runs,)."""
    changes = np.nan_to_num(np.abs(np.diff(column)))
    coarse = resolution(column)
    beyond = np.maximum(changes - coarse, 0.0)
    squares = np.concatenate([[0.0], np.cumsum(beyond**2)])
    repeats = np.concatenate([[0], np.cumsum(changes == 0.0)])
    width = np.clip(stop - first, _LEAST_WINDOW, _LARGEST_WINDOW)
    # The change that ends a freeze makes up for what was missed: it is no habit of the channel.
    low = np.clip([first - 1 - width, stop + 1], 0, changes.size)
    high = np.clip([first - 1, stop + 1 + width], 0, changes.size)
    count, moved = high - low, squares[high] - squares[low]
    with np.errstate(divide="ignore"):
        within = _erf(coarse / (2.0 * np.sqrt(2.0) * np.sqrt(moved / np.maximum(count, 1) / 2.0))).astype(np.float64)
    share = (repeats[high] - repeats[low]) / np.maximum(count, 1)
    enough = count >= _LEAST_WINDOW // 2
    before, after = np.where(enough, np.maximum(within, share), np.nan)
    # A record may begin at rest. Where it ends frozen, what came before tells.
    at_rest = np.where(enough[0], np.fmax(before, after), 1.0)
    # No turning point ends in one leap that outweighs all others beside it: the truth went on as fast as both sides tell.
    leapt = (_leap(column, stop, coarse) ** 2 > moved.sum(axis=0)) & enough.all(axis=0)
    return np.where(leapt, 1.0 - np.sqrt(np.prod(1.0 - share, axis=0)), at_rest)


def _leap(column: FloatArray, stop: IntArray, coarse: float) -> FloatArray:
    """Return how far each run ends in a leap that lasts longer than a spike, beyond one step, (n_runs,)."""
    last = column.size - 1
    lasting = np.minimum(*(np.abs(column[np.minimum(stop + n, last)] - column[stop]) for n in (1, 1 + LONGEST_SPIKE)))
    leap: FloatArray = np.maximum(np.nan_to_num(lasting) - coarse, 0.0)
    return leap
