"""Telemetry in CSV files: a table of channels in their own units <-> a record in SI."""

import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from twin_core._typing import FloatArray, IntArray
from twin_core.csv_table import CsvTable, open_table
from twin_core.errors import TelemetryError
from twin_core.files import replacing
from twin_core.network.plausible import LARGEST, implausible
from twin_core.network.spec import Channel, TwinSpec
from twin_core.telemetry import Record
from twin_core.units import from_si, to_si

TIME, TIME_S = "time", "time_s"
_FIRST_YEAR, _LAST_YEAR = 1970, 2199
_INSTANT = re.compile(r"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d:\d\d(?:\.\d{1,9})?([Zz]|[+-]\d\d:\d\d)?", re.ASCII)
_HOW = "write it like 2026-01-03T00:00:00Z"


def read_csv(path: Path | str, spec: TwinSpec, *, required: Collection[str] | None = None) -> Record:
    """Read a telemetry file.

    Parameters
    ----------
    path
        CSV with a header row; the first column is ``time`` (RFC 3339) or ``time_s`` (seconds), each other one a
        channel. An empty cell is a missing sample. Columns that the specification does not declare are ignored.
    spec
        Declares the channels and their units.
    required
        Channels that the file must have; by default every channel that the twin uses.

    Returns
    -------
    Record
        In SI; ``time_s`` counts from the first row where the file is dated. Its notices name the ignored columns.

    Raises
    ------
    TelemetryError
        With one line naming the file, the row (line of the file, from 1), the column and what to do.
    """
    table = open_table(path)
    if table.header[0] not in (TIME, TIME_S):
        raise TelemetryError(f"{path}: row 1: the first column is '{table.header[0]}', must be '{TIME}' or '{TIME_S}'")
    names = present_channels(str(path), table.header[1:], spec, required)
    if table.header[0] == TIME:
        time_ns = _instants_ns(table)
        epoch_ns: int | None = int(time_ns[0])
        time_s = (time_ns - time_ns[0]) / 1e9
    else:
        epoch_ns, time_s = None, _seconds(table)
    _check_increasing(table, time_s)
    values = {name: _in_si(table, name, spec.channels[name], column) for name, column in table.numbers(names).items()}
    return Record(time_s, values, epoch_ns, str(path), ignored_notice(str(path), table.header[1:], spec))


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
    texts = table.texts(TIME)
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


def _check_increasing(table: CsvTable, time_s: FloatArray) -> None:
    steps = np.diff(time_s)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        problem = (
            "repeats the time of the row before; drop one of them"
            if steps[row - 1] == 0
            else ("is earlier than the row before; sort the rows by time")
        )
        table.refuse(row, table.header[0], problem)


def _in_si(table: CsvTable, name: str, channel: Channel, column: FloatArray) -> FloatArray:
    """Return one channel in SI, plausible everywhere."""
    values = to_si(column, channel.unit)
    fault = implausible(channel, values)
    if fault is not None:
        row, problem = fault
        unit = f" {channel.unit}" if channel.unit else ""
        table.refuse(row, name, f"holds {column[row]:g}{unit}, which {problem}")
    return values


__all__ = ["ignored_notice", "implausible", "present_channels", "read_csv", "write_columns", "write_csv"]
