"""Gaps in which an input went its own way: what was held across one is not what the spacecraft was given."""

from collections.abc import Collection, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace

import numpy as np

from twin_core._typing import FloatArray
from twin_core.telemetry import LEAST_PART, Record, cut_at_gaps

SHORTEST_GAP = 10.0
"""Usual intervals up to which a held value bridges what is missing, whatever it is: a few lost rows end no record."""

UNKNOWN_SHARE = 0.5
"""Share of an input's variance that its change across a gap has from which it is not known there: at half of it the value before
the gap and the mean over the record tell as much."""

N_LAGS = 24
"""Lags at which the variogram is told, from one sample to half the record, each a little longer than the one before."""


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


def segmented(records: Sequence[Record], driving: AbstractSet[str], held: Collection[str]) -> list[Record]:
    """Return records cut at every gap that no fit or prediction is to step through: :func:`cut_at_gaps`, and the above.

    Parameters
    ----------
    records
        Segments of telemetry.
    driving, held
        Channels that drive the model, and those of them that hold from sample to sample.
    """
    return cut_where_inputs_are_unknown(cut_at_gaps(records, driving), held)


def _cut(record: Record, inputs: Sequence[str]) -> list[Record]:
    n_times = record.time_s.size
    if n_times < 2 * LEAST_PART:
        return [record]
    intervals_s = np.diff(record.time_s)
    usual_s = float(np.median(intervals_s))
    gaps = np.flatnonzero(intervals_s > SHORTEST_GAP * usual_s).tolist()
    known_s = {name: usual_s * _known_for(record.values[name]) for name in inputs} if gaps else {}
    starts, notices = [0], [record.notices]
    for last in gaps:
        if last + 1 - starts[-1] < LEAST_PART or n_times - last - 1 < LEAST_PART:
            continue
        unknown = [name for name, span_s in known_s.items() if intervals_s[last] >= span_s]
        if unknown:
            starts.append(last + 1)
            notices.append((_notice(record, last, unknown),))
    parts = record.parts_from(starts, frozenset(inputs))
    return [replace(part, notices=own) for part, own in zip(parts, notices, strict=True)]


def _known_for(column: FloatArray) -> float:
    """Return for how many usual intervals the value of an input is known once it was read, by its variogram; inf if for good."""
    seen = column[np.isfinite(column)]
    variance = float(np.var(seen)) if seen.size else 0.0
    for lag in (
        np.unique(np.geomspace(1.0, column.size / 2, N_LAGS).astype(np.int64)).tolist() if variance > 0.0 else ()
    ):
        change = column[lag:] - column[:-lag]
        change = change[np.isfinite(change)]
        if change.size and 0.5 * float(np.mean(change**2)) >= UNKNOWN_SHARE * variance:
            return float(lag)
    return np.inf


def _notice(record: Record, last: int, unknown: Sequence[str]) -> str:
    before_s, after_s = record.time_s[last : last + 2].tolist()
    return (
        f"{record.name}: no samples from {record.present(before_s)} to {record.present(after_s)}, and {', '.join(unknown)}"
        " changes faster than that: what comes after is taken for a segment of its own"
    )
