"""Gaps in which an input went its own way: what was held across one is not what the spacecraft was given."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from twin_core._typing import FloatArray
from twin_core.telemetry import LEAST_PART, Record

SHORTEST_GAP = 10.0
"""Usual intervals up to which a held value bridges what is missing, whatever it is: a few lost rows end no record."""

UNKNOWN_SHARE = 0.5
"""Share of an input's variance that its change across a gap has from which it is not known there: at half of it the value before
the gap and the mean over the record tell as much."""

N_LAGS = 12


def cut_where_inputs_are_unknown(records: Sequence[Record], inputs: Collection[str]) -> list[Record]:
    """Return records cut at the gaps across which an input does not stay what it was.

    Parameters
    ----------
    records
        Segments of telemetry.
    inputs
        Channels that hold their value until the next sample. One that is constant, or changes slowly beside a gap, is known in
        it; what comes back after an orbit is not known within it.

    Returns
    -------
    list of Record
        Each part has temperatures of its own to begin with; what follows a gap says so in a notice. No part has fewer than
        ``LEAST_PART`` samples: where it would, the record is not cut.
    """
    return [part for record in records for part in _cut(record, sorted(inputs & record.values.keys()))]


def _cut(record: Record, inputs: Sequence[str]) -> list[Record]:
    n_times = record.time_s.size
    if n_times < 2 * LEAST_PART:
        return [record]
    intervals_s = np.diff(record.time_s)
    usual_s = float(np.median(intervals_s))
    starts, notices = [0], [record.notices]
    for last in np.flatnonzero(intervals_s > SHORTEST_GAP * usual_s).tolist():
        if last + 1 - starts[-1] < LEAST_PART or n_times - last - 1 < LEAST_PART:
            continue
        steps = float(intervals_s[last] / usual_s)
        unknown = [name for name in inputs if _changes_within(record.values[name], steps)]
        if unknown:
            starts.append(last + 1)
            notices.append((_notice(record, last, unknown),))
    parts = record.parts_from(starts, frozenset(inputs))
    return [replace(part, notices=own) for part, own in zip(parts, notices, strict=True)]


def _changes_within(column: FloatArray, steps: float) -> bool:
    """Return whether an input changes so much within a gap of so many usual intervals, as its variogram tells."""
    variance = float(np.nanvar(column)) if np.isfinite(column).any() else 0.0
    if variance == 0.0:
        return False
    lags = np.unique(np.geomspace(1.0, np.clip(steps, 1.0, column.size / 2), N_LAGS).astype(np.int64)).tolist()
    apart = [change[np.isfinite(change)] for change in (column[lag:] - column[:-lag] for lag in lags)]
    return max((0.5 * float(np.mean(change**2)) for change in apart if change.size), default=0.0) >= (
        UNKNOWN_SHARE * variance
    )


def _notice(record: Record, last: int, unknown: Sequence[str]) -> str:
    before_s, after_s = record.time_s[last : last + 2].tolist()
    return (
        f"{record.name}: no samples from {record.present(before_s)} to {record.present(after_s)}, and {', '.join(unknown)}"
        " changes faster than that: what comes after is taken for a segment of its own"
    )
