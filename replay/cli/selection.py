"""Which part of the telemetry a command takes: a stretch of time, its newest samples, or one of so many."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import click
import numpy as np

from replay.cli.recordings import LEAST_SAMPLES
from replay.wording import counted
from twin_core.calibrate.approach import thinned
from twin_core.errors import TelemetryError
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record
from twin_core.units import calendar_instant


@dataclass(frozen=True)
class Wanted:
    """What is asked for: at most ``samples`` of start <= time < stop, the newest, or with ``thin`` evenly over that time."""

    start: str | None = None
    stop: str | None = None
    samples: int | None = None
    thin: bool = False

    def __post_init__(self) -> None:
        """Refuse what contradicts itself."""
        if self.thin and self.samples is None:
            raise click.UsageError("--thin needs --samples: how many are to be left")


def selected(spec: TwinSpec, records: Sequence[Record], wanted: Wanted) -> list[Record]:
    """Return the part of some segments that is wanted, in their order; a notice of the first says what it is.

    Parameters
    ----------
    spec
        Tells which channels hold until their next sample: a part begins with what holds there.
    records
        Segments of telemetry, the newest last.
    wanted
        The part.

    Raises
    ------
    TelemetryError
        If it holds too few samples, or a time is written in another form than the telemetry's.
    """
    if wanted == Wanted():
        return list(records)
    inside = [part for record in records if (part := _between(_held(spec, record), wanted)) is not None]
    count = sum(record.time_s.size for record in inside)
    if count < LEAST_SAMPLES:
        raise TelemetryError(
            f"{records[0].name}: {counted(count, 'sample')} in the selected part, {LEAST_SAMPLES} are needed; select more"
        )
    most = count if wanted.samples is None else wanted.samples
    if count <= most:
        return _noted(inside, f"{count:,} samples")
    if wanted.thin:
        stride = -(-count // most)
        thin = [thinned(spec, record, stride) for record in inside]
        kept = sum(record.time_s.size for record in thin)
        return _noted(thin, f"{kept:,} of {count:,} samples, one in {stride}")
    newest: list[Record] = []
    for record in reversed(inside):
        left = most - sum(one.time_s.size for one in newest)
        if left > 0:
            newest.insert(0, _part(record, np.arange(record.time_s.size) >= record.time_s.size - left))
    return _noted(newest, f"the newest {most:,} of {count:,} samples")


def _between(record: Record, wanted: Wanted) -> Record | None:
    """Return what of a segment lies in the wanted time, None where nothing does."""
    keep = np.ones(record.time_s.size, dtype=bool)
    if wanted.start is not None:
        keep &= record.time_s >= _located_s(record, wanted.start)
    if wanted.stop is not None:
        keep &= record.time_s < _located_s(record, wanted.stop)
    return _part(record, keep) if keep.any() else None


def _located_s(record: Record, time: str) -> float:
    """Return the segment's own seconds of a time; a number is one of seconds."""
    try:
        seconds = float(time)
    except ValueError:
        return record.locate_s(calendar_instant(time))
    if record.epoch_ns is not None:
        raise TelemetryError(f"{record.name}: '{time}' is a number of seconds, the record is dated")
    return seconds


def _held(spec: TwinSpec, record: Record) -> Record:
    """Return a segment in which every input that holds is written out, wherever it was sampled."""
    values = dict(record.values)
    for name, column in record.values.items():
        if spec.channels[name].is_held and name not in spec.sensors:
            last = np.maximum.accumulate(np.where(np.isfinite(column), np.arange(column.size), -1))
            values[name] = np.where(last >= 0, column[np.maximum(last, 0)], np.nan)
    return replace(record, values=values)


def _part(record: Record, keep: np.ndarray) -> Record:
    """Return some samples of a segment, with the flaws that lie among them."""
    part = record.take(keep)
    if part.flaws is None:
        return part
    among = tuple(f for f in part.flaws if f.stop_s >= part.time_s[0] and f.start_s <= part.time_s[-1])
    return replace(part, flaws=among)


def _noted(records: Sequence[Record], words: str) -> list[Record]:
    """Return segments of which the first says what has been taken."""
    first, last = records[0], records[-1]
    said = f"takes {words}, {first.present(first.time_s[0])} to {last.present(last.time_s[-1])}"
    return [replace(first, notices=(*first.notices, said)), *records[1:]]
