"""Telemetry files of either format -> records in SI, and back."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from replay.bridges.foxglove_messages import Picture
from replay.errors import ReplayError
from replay.mapping import apply_mapping, map_topics
from replay.mcap_io import read_mcap, read_mcap_segments, write_mcap
from replay.recording import Recording
from replay.wording import counted
from twin_core.errors import TelemetryError
from twin_core.network.screened import all_screened
from twin_core.network.spec import TwinSpec
from twin_core.quality import unmasked
from twin_core.quality.sentinels import marked
from twin_core.telemetry import Record
from twin_core.telemetry_csv import (
    ignored_notice,
    implausible,
    present_channels,
    read_csv,
    read_segments,
    write_columns,
)
from twin_core.units import format_instant, from_si, to_si

if TYPE_CHECKING:
    from twin_core.fem.film import Film

DATED = "dated"
"""Metadata of an MCAP file: "false" where log times are seconds since an unknown start."""
SUFFIXES = (".csv", ".mcap")
LEAST_SAMPLES = 20
"""So many samples a calibration should have, and a part of a record that is asked for must have."""
_TEMPERATURE_UNITS = ("K", "degC")


def load_record(path: Path, spec: TwinSpec, *, required: Collection[str] | None = None) -> Record:
    """Read one telemetry file that holds one segment, as it is; see :func:`load_segments`."""
    check_suffix(path)
    if path.suffix == ".csv":
        return read_csv(path, spec, required=required)
    return _from_recording(path, read_mcap(path), spec, required)


def load_segments(paths: Sequence[Path], spec: TwinSpec, *, masking: bool = True) -> list[Record]:
    """Read telemetry files, CSV or MCAP, as segments: a new one begins with each file, and where the clock jumps back.

    Parameters
    ----------
    paths
        Files ending in .csv or .mcap.
    spec
        Declares channels and units; the topics of an MCAP file are matched by name or by their last part.
    masking
        Leave out samples that cannot be readings.

    Raises
    ------
    TelemetryError, RecordingError
        With one line naming the file and what is wrong.
    """
    segments = [segment for path in paths for segment in _segments_of(path, spec)]
    if masking:
        return all_screened(spec, segments)
    for segment in segments:
        _check_plausible(spec, segment)
    return [unmasked(segment) for segment in segments]


def _segments_of(path: Path, spec: TwinSpec) -> list[Record]:
    """Read one file as it is."""
    check_suffix(path)
    if path.suffix == ".csv":
        return read_segments(path, spec)
    segments = [_from_recording(path, part, spec, None) for part in read_mcap_segments(path)]
    if len(segments) > 1:
        said = f"{path}: the clock jumps back {counted(len(segments) - 1, 'time')}; a new segment begins at each"
        segments[0] = replace(segments[0], notices=(*segments[0].notices, said))
    return segments


def _check_plausible(spec: TwinSpec, record: Record) -> None:
    """Refuse markers of missing samples that nobody is to mask."""
    for channel, column in record.values.items():
        fault = implausible(spec.channels[channel], column)
        if fault is not None:
            at = record.present(record.time_s[fault[0]])
            raise TelemetryError(f"{record.name}: sample at {at}: channel '{channel}' {fault[1]}")


def load_records(paths: Sequence[Path], spec: TwinSpec, *, masking: bool = True) -> list[Record]:
    """Read several files as segments of one record, in the order given.

    Raises
    ------
    TelemetryError
        If a file is wrong, named twice, or only some of them (or of the excluded intervals) are dated.
    """
    for position, path in enumerate(paths):
        if path.resolve() in [earlier.resolve() for earlier in paths[:position]]:
            raise TelemetryError(f"{path}: is named twice; each segment counts once")
    records = load_segments(paths, spec, masking=masking)
    for record in records:
        if (record.epoch_ns is None) != (records[0].epoch_ns is None):
            raise TelemetryError(f"{record.name}: {_form(record)}, {records[0].name} {_form(records[0])}; use one form")
        check_exclude(spec, record)
    if records:
        _check_sampled(spec, records)
    return records


def too_short(records: Sequence[Record]) -> list[str]:
    """Return a notice of records that have too few samples to determine parameters."""
    count = sum(record.time_s.size for record in records)
    if not records or count >= LEAST_SAMPLES:
        return []
    names = ", ".join(dict.fromkeys(record.name for record in records))
    return [
        f"{names}: {counted(count, 'sample')} in all, too few to determine parameters reliably; give at least "
        f"{LEAST_SAMPLES} samples, preferably over a full orbit or several time constants"
    ]


def _check_sampled(spec: TwinSpec, records: Sequence[Record]) -> None:
    """Refuse a channel of which no file holds a sample."""
    for channel in spec.used_channels:
        if not any(np.isfinite(record.values[channel]).any() for record in records):
            names = ", ".join(record.name for record in records)
            masked = sorted({f.reason for record in records for f in record.flaws or () if f.channel == channel})
            what = f"no readings, for all its samples are masked ({', '.join(masked)})" if masked else "no samples"
            mend = "correct" if masked else "add"
            raise TelemetryError(
                f"{names}: channel '{channel}' has {what}; {mend} them or remove it from the specification"
            )


def check_exclude(spec: TwinSpec, record: Record) -> None:
    """Refuse excluded intervals that are written in another form of time than the telemetry."""
    for position, interval in enumerate(spec.exclude):
        if isinstance(interval.start, str) != (record.epoch_ns is not None):
            form = "a date" if isinstance(interval.start, str) else "a number of seconds"
            raise TelemetryError(
                f"exclude[{position}].start: is {form}, but {record.name} {_form(record)}; write the same form"
            )


def check_apart(records: Sequence[Record], held_out: Sequence[Record]) -> None:
    """Refuse a hold-out that shares a file or, where dated, a time with the training telemetry."""
    for held in held_out:
        for record in records:
            if Path(held.name).resolve() == Path(record.name).resolve():
                raise TelemetryError(f"{held.name}: is both telemetry and hold-out; a hold-out must be kept apart")
            if (held.epoch_ns is None) != (record.epoch_ns is None):
                raise TelemetryError(f"{held.name}: {_form(held)}, {record.name} {_form(record)}; use one form")
            if held.epoch_ns is not None and _overlap(held, record):
                raise TelemetryError(f"{held.name}: overlaps {record.name} in time; a hold-out must be kept apart")


def _overlap(one: Record, other: Record) -> bool:
    (start, stop), (other_start, other_stop) = _span_ns(one), _span_ns(other)
    return start <= other_stop and other_start <= stop


def _span_ns(record: Record) -> tuple[int, int]:
    epoch_ns = record.epoch_ns or 0
    return epoch_ns + round(record.time_s[0] * 1e9), epoch_ns + round(record.time_s[-1] * 1e9)


def _form(record: Record) -> str:
    return "counts seconds" if record.epoch_ns is None else "is dated"


def save_record(
    path: Path,
    record: Record,
    units: Mapping[str, str | None],
    metadata: Mapping[str, str],
    attachments: Mapping[str, bytes] | None = None,
    film: "Film | None" = None,
) -> None:
    """Write a record in the units given, as CSV or MCAP; the latter with attachments and pictures of the field.

    The file appears whole or not at all.
    """
    check_suffix(path)
    if path.suffix == ".csv":
        write_columns(path, record, dict(units))
        return
    if not path.parent.is_dir():
        raise TelemetryError(f"{path}: cannot be written (no such folder); choose a folder that exists")
    time_ns = (record.epoch_ns or 0) + np.rint(record.time_s * 1e9).astype(np.int64)
    columns = {name: from_si(values, units[name]) for name, values in record.values.items()}
    stated = {name: unit for name, unit in units.items() if unit is not None}
    dated = "false" if record.epoch_ns is None else "true"
    pictures = [] if film is None else _pictures(film, record.epoch_ns or 0)
    write_mcap(path, time_ns, columns, stated, {**metadata, DATED: dated}, attachments, pictures)


def _pictures(film: "Film", epoch_ns: int) -> list[Picture]:
    return [
        Picture(epoch_ns + round(time_s * 1e9), field, film.origin_m, film.cell_m)
        for time_s, field in zip(film.time_s, film.temperature_K, strict=True)
    ]


def check_suffix(path: Path, suffixes: Sequence[str] = SUFFIXES) -> None:
    """Refuse a file whose name does not tell one of the formats."""
    if path.suffix not in suffixes:
        raise TelemetryError(f"{path}: the name must end in {' or '.join(suffixes)}")


def convert_units(recording: Recording, spec: TwinSpec, name: str) -> Recording:
    """Return a recording, columns named by channel, with its temperatures in the units of the specification.

    Raises
    ------
    ReplayError
        If the file states a unit that is no other spelling of the channel's own.
    """
    columns = dict(recording.columns)
    for channel, unit in recording.units.items():
        wanted = spec.channels[channel].unit
        if wanted is None or unit == wanted:
            continue
        if unit not in _TEMPERATURE_UNITS or wanted not in _TEMPERATURE_UNITS:
            raise ReplayError(f"{name}: channel '{channel}' is in {unit}, the specification says {wanted}; correct one")
        columns[channel] = from_si(to_si(columns[channel], unit), wanted)
    return Recording(recording.time_ns, columns, {}, recording.metadata)


def _from_recording(path: Path, recording: Recording, spec: TwinSpec, required: Collection[str] | None) -> Record:
    name = str(path)
    topics = list(recording.columns)
    try:
        mapping = map_topics(topics, list(spec.channels), ignore_others=True)
    except ReplayError as error:
        raise TelemetryError(f"{name}: {error}") from error
    named = convert_units(apply_mapping(recording, mapping), spec, name)
    present_channels(name, list(named.columns), spec, required)
    dated = recording.metadata.get(DATED) != "false"
    epoch_ns = int(named.time_ns[0]) if dated else None
    time_s = (named.time_ns - (epoch_ns or 0)) / 1e9
    values = {channel: to_si(column, spec.channels[channel].unit) for channel, column in named.columns.items()}
    for channel, column in values.items():
        readings = np.where(marked(column, spec.channels[channel].unit), np.nan, column)
        fault = implausible(spec.channels[channel], readings)
        if fault is not None:
            at = format_instant(int(named.time_ns[fault[0]])) if dated else f"{time_s[fault[0]]:g} s"
            raise TelemetryError(f"{name}: sample at {at}: channel '{channel}' {fault[1]}")
    ignored = ignored_notice(name, [mapping.get(topic, topic) for topic in topics], spec)
    heard = tuple(f"{name}: {notice}" for notice in recording.notices)
    return Record(time_s, values, epoch_ns, name, (*ignored, *heard))
