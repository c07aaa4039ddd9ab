"""Telemetry in CSV files: a table of channels in their own units <-> a record in SI."""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from twin_core._typing import FloatArray, IntArray
from twin_core.csv_table import CsvTable, open_table
from twin_core.errors import TelemetryError
from twin_core.files import replacing
from twin_core.network.plausible import LARGEST, implausible
from twin_core.network.spec import Channel, TwinSpec
from twin_core.quality.sentinels import marked
from twin_core.telemetry import LEAST_PART, Record
from twin_core.units import calendar_instant, from_si, to_si
from twin_core.wording import counted

TIME, TIME_S = "time", "time_s"
_FIRST_YEAR, _LAST_YEAR = 1970, 2199
_INSTANT = re.compile(r"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d:\d\d(?:\.\d{1,9})?([Zz]|[+-]\d\d:\d\d)?", re.ASCII)
_HOW = "write it like 2026-01-03T00:00:00Z"


def read_csv(path: Path | str, spec: TwinSpec, *, required: Collection[str] | None = None) -> Record:
    """Read a telemetry file that holds one segment, as :func:`read_segments` does; TelemetryError if it holds several."""
    segments = read_segments(path, spec, required=required)
    if len(segments) > 1:
        at = segments[1].present(segments[1].time_s[0])
        raise TelemetryError(
            f"{path}: its clock jumps back to {at}; sort the rows by time, or write a file for each part"
        )
    return segments[0]


def read_segments(path: Path | str, spec: TwinSpec, *, required: Collection[str] | None = None) -> list[Record]:
    """Read a telemetry file.

    Where the clock jumps back a new segment begins. A row that repeats the instant of the row before it is dropped: the
    first one stays.

    Parameters
    ----------
    path
        CSV with a header row; the first column is ``time`` (RFC 3339, or with the day of the year) or ``time_s``
        (seconds), each other one a channel. An empty cell is a missing sample. Columns that the specification does not
        declare are ignored. Where all of three rows and more carry one instant, the clock stands still: an error.
    spec
        Declares the channels and their units.
    required
        Channels that the file must have; by default every channel that the twin uses.

    Returns
    -------
    list of Record
        Segments in SI, in the order of the file; ``time_s`` counts from the segment's first row where the file is dated.
        The notices name the ignored columns and count the repeated instants. Markers of missing samples are still there.

    Raises
    ------
    TelemetryError
        With one line naming the file, the row (line of the file, from 1), the column and what to do.
    """
    table = open_table(path)
    if table.header[0] not in (TIME, TIME_S):
        raise TelemetryError(f"{path}: row 1: the first column is '{table.header[0]}', must be '{TIME}' or '{TIME_S}'")
    names = present_channels(str(path), table.header[1:], spec, required)
    dated = table.header[0] == TIME
    clock: IntArray | FloatArray = _instants_ns(table) if dated else _seconds(table)
    values = {name: _in_si(table, name, spec.channels[name], column) for name, column in table.numbers(names).items()}
    notices = list(ignored_notice(str(path), table.header[1:], spec))
    kept = _first_of_instants(str(path), clock, values, notices)
    _refuse_standing_clock(table, values, kept)
    segments: list[Record] = []
    for rows in _forward_runs(table, clock, kept, notices):
        epoch_ns = int(clock[rows[0]]) if dated else None
        time_s = (clock[rows] - epoch_ns) / 1e9 if epoch_ns is not None else clock[rows].astype(np.float64)
        columns = {name: column[rows] for name, column in values.items()}
        segments.append(Record(time_s, columns, epoch_ns, str(path), () if segments else tuple(notices)))
    return segments


def _first_of_instants(
    name: str, clock: IntArray | FloatArray, values: Mapping[str, FloatArray], notices: list[str]
) -> IntArray:
    """Return the rows that do not repeat the instant of the row before, and note how many do."""
    repeats = np.flatnonzero(np.diff(clock) == 0) + 1
    if not repeats.size:
        return np.arange(clock.size)
    other = np.zeros(repeats.size, dtype=np.bool_)
    for column in values.values():
        both = np.isfinite(column[repeats]) | np.isfinite(column[repeats - 1])
        other |= both & (column[repeats] != column[repeats - 1])
    same, differing = int((~other).sum()), int(other.sum())
    if same:
        repeat = counted(same, "row repeats", "rows repeat")
        notices.append(f"{name}: {repeat} the instant and the values of the row before; dropped")
    if differing:
        repeat = counted(differing, "row repeats", "rows repeat")
        notices.append(f"{name}: {repeat} the instant of the row before with other values; the first stays")
    return np.setdiff1d(np.arange(clock.size), repeats)


def _refuse_standing_clock(table: CsvTable, values: Mapping[str, FloatArray], kept: IntArray) -> None:
    """Refuse a file all of whose rows carry one instant though their values change; the same row may be sent many times."""
    changes = any((column != column[0])[np.isfinite(column)].any() for column in values.values())
    if kept.size == 1 and table.line.size > 2 and changes:
        time, at = table.header[0], table.texts(table.header[0])[0]
        raise TelemetryError(
            f"{table.name}: column '{time}': all {table.line.size} rows have the same time, {at}; give each row the time of "
            "its own sample"
        )


def _forward_runs(table: CsvTable, clock: IntArray | FloatArray, kept: IntArray, notices: list[str]) -> list[IntArray]:
    """Return the rows of each segment: a new one begins where the clock jumps back.

    Segments of less than ``LEAST_PART`` samples tell nothing and are left out; a file of nothing else is not sorted.
    """
    back = np.flatnonzero(np.diff(clock[kept]) < 0) + 1
    if not back.size:
        return [kept]
    runs = np.split(kept, back)
    long = [run for run in runs if run.size >= LEAST_PART]
    if not long:
        table.refuse(int(kept[back[0]]), table.header[0], "is earlier than the row before; sort the rows by time")
    said = f"{table.name}: the clock jumps back {counted(back.size, 'time')}, first in row {table.line[kept[back[0]]]}"
    scraps = sum(run.size for run in runs) - sum(run.size for run in long)
    left_out = f"; {counted(scraps, 'row between jumps is', 'rows between jumps are')} left out" if scraps else ""
    notices.append(f"{said}; a new segment begins at each{left_out}")
    return long


def present_channels(
    name: str, columns: Sequence[str], spec: TwinSpec, required: Collection[str] | None = None
) -> list[str]:
    """Return the declared channels among the columns; TelemetryError if a required one is not among them."""
    for channel in spec.used_channels if required is None else required:
        if channel not in columns:
            raise TelemetryError(
                f"{name}: channel '{channel}' of the specification has no column;"
                f" add it or correct its name (columns: {', '.join(columns) or 'none'})"
            )
    return [column for column in columns if column in spec.channels]


def ignored_notice(name: str, columns: Sequence[str], spec: TwinSpec) -> tuple[str, ...]:
    """Return the notice about columns that the specification does not declare."""
    ignored = [column for column in columns if column not in spec.channels]
    return (f"{name}: ignored columns that the specification does not name: {', '.join(ignored)}",) if ignored else ()


def write_csv(path: Path | str, record: Record, spec: TwinSpec) -> None:
    """Write a record as CSV in the channels' own units; the file appears whole or not at all.

    Raises
    ------
    TwinError
        If the file cannot be written.
    """
    write_columns(path, record, {name: spec.channels[name].unit for name in record.values})


def write_columns(path: Path | str, record: Record, units: dict[str, str | None]) -> None:
    """Write a record as CSV, each channel in the unit given; TwinError if the file cannot be written."""
    if record.epoch_ns is None:
        columns: dict[str, object] = {TIME_S: record.time_s}
    else:
        columns = {TIME: _spell(record.epoch_ns + np.rint(record.time_s * 1e9).astype(np.int64))}
    for name, values in record.values.items():
        column = from_si(values, units[name])
        # A nanokelvin of rounding hides the dust that subtracting 273.15 leaves behind.
        columns[name] = np.round(column, 9) if units[name] == "degC" else column
    with replacing(path) as partial:
        pd.DataFrame(columns).to_csv(partial, index=False)


def _spell(time_ns: IntArray) -> list[str]:
    """Return RFC 3339 UTC, with microseconds only where there are any (as ``units.format_instant``, but all at once)."""
    stamps = ((time_ns + 500) // 1000).astype("datetime64[us]")
    texts = np.datetime_as_string(stamps, unit="s")
    fractional = stamps.astype(np.int64) % 1_000_000 != 0
    if fractional.any():
        texts = np.where(fractional, np.datetime_as_string(stamps, unit="us"), texts)
    return [f"{text}Z" for text in texts.tolist()]


def _instants_ns(table: CsvTable) -> IntArray:
    """Return unix nanoseconds of the time column, (n_rows,)."""
    texts = [calendar_instant(text) for text in table.texts(TIME)]
    for row, text in enumerate(texts):
        match = _INSTANT.fullmatch(text)
        if match is None:
            hint = " (or name the column time_s)" if _is_number(text) else ""
            problem = "is empty" if not text else f"holds '{text[:40]}', which is not an RFC 3339 instant"
            table.refuse(row, TIME, f"{problem}; {_HOW}{hint}")
        elif match[1] is None:
            table.refuse(row, TIME, f"holds '{text}', which names no UTC offset; {_HOW}")
    series = pd.Series(texts).str.upper()
    instants = pd.to_datetime(series, utc=True, format="ISO8601", errors="coerce")
    years = instants.dt.year.to_numpy(dtype=np.float64, na_value=np.nan)
    wrong = ~((years >= _FIRST_YEAR) & (years <= _LAST_YEAR))
    if wrong.any():
        row = int(np.argmax(wrong))
        table.refuse(
            row, TIME, f"holds '{texts[row]}', which is no date between {_FIRST_YEAR} and {_LAST_YEAR}; correct it"
        )
    return instants.astype("datetime64[ns, UTC]").to_numpy(dtype="datetime64[ns]").astype(np.int64)


def _is_number(text: str) -> bool:
    return text.replace(".", "", 1).removeprefix("-").isdigit()


def _seconds(table: CsvTable) -> FloatArray:
    time_s = table.numbers([TIME_S])[TIME_S]
    if np.isnan(time_s).any():
        table.refuse(int(np.argmax(np.isnan(time_s))), TIME_S, "is empty; give every row its time in seconds")
    if (np.abs(time_s) > LARGEST).any():
        table.refuse(int(np.argmax(np.abs(time_s) > LARGEST)), TIME_S, "is too large to be seconds; correct its unit")
    return time_s


def _in_si(table: CsvTable, name: str, channel: Channel, column: FloatArray) -> FloatArray:
    """Return one channel in SI, plausible everywhere but for markers of missing samples."""
    values = to_si(column, channel.unit)
    refuse_implausible(table, name, channel, np.where(marked(values, channel.unit), np.nan, column))
    return values


def refuse_implausible(table: CsvTable, name: str, channel: Channel, column: FloatArray) -> None:
    """Refuse a column, in the channel's own unit, that holds what no instrument reads; TelemetryError names the row."""
    fault = implausible(channel, to_si(column, channel.unit))
    if fault is not None:
        row, problem = fault
        unit = f" {channel.unit}" if channel.unit else ""
        table.refuse(row, name, f"holds {column[row]:g}{unit}, which {problem}")


__all__ = [
    "ignored_notice",
    "implausible",
    "present_channels",
    "read_csv",
    "read_segments",
    "refuse_implausible",
    "write_columns",
    "write_csv",
]
