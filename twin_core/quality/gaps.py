"""Gaps in which an input went its own way: what was held across one is not what the spacecraft was given.

Whole rows may be missing, or the samples of one channel while the rows go on: a lapse. A channel may have a clock of its own, or
report a change only: a lapse is long beside what most of the record's time is sampled with, lapses as long as it included.
"""

from collections.abc import Collection, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.quality.runs import runs_of
from twin_core.telemetry import LEAST_PART, Record, cut_at_gaps
from twin_core.wording import counted

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


def without_lapses(records: Sequence[Record], driving: AbstractSet[str], needed: Collection[str]) -> list[Record]:
    """Return records without the rows in which an input has no samples and does not stay what it was.

    Parameters
    ----------
    records
        Segments of telemetry.
    driving
        Channels that drive the model, or might. A lapse of any of them is told in the notices of its record's first part.
    needed
        Those without which nothing can be predicted.

    Returns
    -------
    list of Record
        What follows a lapse has temperatures of its own to begin with. Parts of fewer than ``LEAST_PART`` samples are left out
        with it; where no other would stay, the lapses are bridged and told.
    """
    return [part for record in records for part in _known_parts(record, driving, frozenset(needed))]


def segmented(
    records: Sequence[Record], driving: AbstractSet[str], held: Collection[str], needed: Collection[str]
) -> list[Record]:
    """Return records cut at every gap that no fit or prediction is to step through: :func:`cut_at_gaps`, and the above.

    Parameters
    ----------
    records
        Segments of telemetry.
    driving, held, needed
        Channels that drive the model or might, those of them that hold from sample to sample, and those that it needs.
    """
    return cut_where_inputs_are_unknown(without_lapses(cut_at_gaps(records, driving), driving, needed), held)


@dataclass(frozen=True, eq=False)
class _Lapse:
    """A time in which one channel has no samples.

    Attributes
    ----------
    channel
        Its name.
    begin_s, end_s
        Its last sample before and its first one after, or the ends of the record.
    lacking : (n_times,)
        The rows in which another sample was due.
    known
        Whether it changes more slowly than that.
    """

    channel: str
    begin_s: float
    end_s: float
    lacking: BoolArray
    known: bool


def _known_parts(record: Record, driving: AbstractSet[str], needed: AbstractSet[str]) -> list[Record]:
    """Return the parts of a record in which all needed channels are known; the first one tells of all lapses."""
    lapses = [lapse for name in sorted(driving & record.values.keys()) for lapse in _lapses(record, name)]
    if not lapses:
        return [record]
    unknown = [lapse for lapse in lapses if lapse.channel in needed and not lapse.known]
    lacking = np.zeros(record.time_s.size, dtype=np.bool_)
    for lapse in unknown:
        lacking |= lapse.lacking
    first, stop = runs_of(~lacking)
    long = stop - first >= LEAST_PART
    cut = unknown if long.any() else []
    gone = np.full(lacking.size, bool(cut))
    for begin, end in zip(first[long].tolist(), stop[long].tolist(), strict=True):
        gone[begin:end] = False
    notices = (*record.notices, *_lapse_notices(record, lapses, cut, gone))
    if not cut:
        return [replace(record, notices=notices)]
    bounds = np.unique([0, *first[long], *stop[long]])
    starts = bounds[bounds < record.time_s.size].tolist()
    parts = zip(starts, record.parts_from(starts, driving), strict=True)
    kept = [part for start, part in parts if start in first[long]]
    return [replace(part, notices=() if k else notices) for k, part in enumerate(kept)]


def _lapses(record: Record, channel: str) -> Iterator[_Lapse]:
    """Yield the lapses of a channel: more than ``SHORTEST_GAP`` times as long as the intervals that fill most other time."""
    time_s, column = record.time_s, record.values[channel]
    at = np.flatnonzero(np.isfinite(column))
    if at.size < 2:
        return
    bounds_s = np.concatenate([time_s[:1], time_s[at], time_s[-1:]])
    intervals_s = np.diff(bounds_s)
    ordered_s = np.sort(intervals_s)
    filled_s = np.concatenate([[0.0], np.cumsum(ordered_s)])
    denser_s = filled_s[np.searchsorted(ordered_s, intervals_s / SHORTEST_GAP)]
    usual_s = float(np.median(np.diff(time_s[at])))
    found = []
    for k in np.flatnonzero(denser_s > 0.5 * (filled_s[-1] - intervals_s)).tolist():
        begin_s, end_s = bounds_s[k : k + 2].tolist()
        due = time_s > begin_s + 1.01 * usual_s if k else time_s < end_s
        lacking = due & ((time_s < end_s) | (k == at.size))
        if lacking.any():
            found.append((begin_s, end_s, lacking))
    known_s = usual_s * _known_for(column[at]) if found else 0.0
    for begin_s, end_s, lacking in found:
        yield _Lapse(channel, begin_s, end_s, lacking, end_s - begin_s < known_s)


def _lapse_notices(record: Record, lapses: Sequence[_Lapse], cut: Sequence[_Lapse], gone: BoolArray) -> Iterator[str]:
    """Yield one sentence for each channel and what is made of its lapses; of those bridged, where rows are not gone anyway."""
    told: dict[tuple[str, str], list[tuple[_Lapse, int]]] = {}
    for lapse in lapses:
        rows = int((lapse.lacking if lapse in cut else lapse.lacking & ~gone).sum())
        if rows == 0:
            continue
        if lapse in cut:
            fate = "changes faster than that: {} left out; a new segment begins with its next sample"
        elif lapse.known:
            fate = "changes more slowly than that: {} given the values beside them"
        else:
            fate = "changes faster than that, yet {} given the values beside them; add its samples, or leave them out"
        told.setdefault((lapse.channel, fate), []).append((lapse, rows))
    for (channel, fate), same in told.items():
        begin, end = record.present(same[0][0].begin_s), record.present(same[0][0].end_s)
        again = f" (and {counted(len(same) - 1, 'more such time')})" if len(same) > 1 else ""
        rows = sum(count for _, count in same)
        said = fate.format(counted(rows, "row is", "rows are"))
        yield f"{record.name}: channel '{channel}' has no samples from {begin} to {end}{again}, and {said}"


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
