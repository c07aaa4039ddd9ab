"""MCAP files: one topic per telemetry channel, JSON messages with a JSON Schema, log time = sample time.

A message is ``{"value": number}``; a foreign file may carry several numeric fields per message, each of which
becomes a column ``topic.field``. Viewers such as Foxglove, Lichtblick and PlotJuggler plot ``<topic>.value``.
"""

import struct
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import orjson
from mcap.exceptions import McapError
from mcap.reader import make_reader
from numpy.typing import NDArray

from replay.bridges.foxglove_messages import SCHEMAS, Picture
from replay.errors import RecordingError
from replay.mcap_writer import VALUE, McapWriter
from replay.recording import Recording, align

Samples = dict[str, tuple[list[int], list[float]]]

LEAST_SEGMENT = 20
"""Fewer instants between two backward steps are no segment: the writer was out of order."""


def write_mcap(
    path: Path | str,
    time_ns: NDArray[np.int64],
    columns: Mapping[str, NDArray[np.float64]],
    units: Mapping[str, str] | None = None,
    metadata: Mapping[str, str] | None = None,
    attachments: Mapping[str, bytes] | None = None,
    pictures: Sequence[Picture] = (),
) -> None:
    """Write columns to an MCAP file, messages in the order of time; the file appears whole or not at all.

    Parameters
    ----------
    path
        Where to write; an existing file is replaced.
    time_ns : (n_times,)
        Unix nanoseconds, strictly increasing, not negative.
    columns : topic -> (n_times,)
        Values in their own unit; NaN writes no message.
    units : topic -> unit
        Noted in the schema and in the channel's metadata.
    metadata
        Text pairs kept in the file.
    attachments
        File name -> content of files that are kept in it.
    pictures
        Fields in the order of time, each written as a grid before the samples of its instant.

    Raises
    ------
    RecordingError
        If an instant is negative, a value infinite, a shape wrong or the file cannot be written.
    """
    target = Path(path)
    recording = Recording(time_ns, columns, units or {}, metadata or {})
    _check_writable(target, recording)
    told = (recording.columns, recording.units, recording.metadata)
    with McapWriter(target, *told, attachments=attachments) as writer:
        rows = [(topic, column.tolist()) for topic, column in recording.columns.items()]
        waiting = deque(pictures)
        for row, instant_ns in enumerate(recording.time_ns.tolist()):
            while waiting and waiting[0].instant_ns <= instant_ns:
                writer.picture(waiting.popleft())
            for topic, values in rows:
                writer.add(topic, instant_ns, values[row])


def _check_writable(target: Path, recording: Recording) -> None:
    if recording.time_ns.size and recording.time_ns[0] < 0:
        raise RecordingError(f"{target}: row 1: time is before 1970, which an MCAP log time cannot express")
    for name, column in recording.columns.items():
        if np.isinf(column).any():
            row = int(np.argmax(np.isinf(column))) + 1
            raise RecordingError(f"{target}: row {row}: channel '{name}' is infinite")


def read_mcap(path: Path | str) -> Recording:
    """Read every numeric JSON message of an MCAP file.

    Returns
    -------
    Recording
        One column per topic whose messages are ``{"value": number}``, one per ``topic.field`` otherwise,
        on the union of their log times.

    Raises
    ------
    RecordingError
        If the file is missing, truncated, not MCAP, not JSON-encoded, or holds no numeric message.
    """
    (whole,) = _opened(Path(path), cut=False)
    return whole


def read_mcap_segments(path: Path | str) -> list[Recording]:
    """Read an MCAP file as :func:`read_mcap` does, but begin a new segment where its clock jumps back.

    Topics that were written a little out of order are no jump: where a segment would have fewer than ``LEAST_SEGMENT``
    instants, the file is one segment in the order of time.
    """
    return _opened(Path(path), cut=True)


def _opened(source: Path, *, cut: bool) -> list[Recording]:
    try:
        with source.open("rb") as stream:
            return _read(source, stream, cut)
    except OSError as error:
        raise RecordingError(f"{source}: cannot be read ({error.strerror or error})") from error
    except (McapError, struct.error, UnicodeDecodeError, EOFError) as error:
        reason = str(error) or "it ends too early"
        raise RecordingError(f"{source}: not a complete MCAP file ({reason}); record or copy it again") from error


def _read(source: Path, stream: IO[bytes], cut: bool) -> list[Recording]:
    if not source.stat().st_size:
        raise RecordingError(f"{source}: is empty; record or copy it again")
    reader = make_reader(stream)
    samples: Samples = {}
    units: dict[str, str] = {}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        if schema is not None and schema.name in SCHEMAS:
            continue  # events and pictures, which are no telemetry
        if channel.message_encoding != "json":
            raise RecordingError(
                f"{source}: topic '{channel.topic}' is encoded as {channel.message_encoding}, not json"
            )
        for name, value in _numbers(source, channel.topic, message.data):
            times, values = samples.setdefault(name, ([], []))
            times.append(message.log_time)
            values.append(value)
            if channel.metadata.get("unit"):
                units[name] = channel.metadata["unit"]
    if not samples:
        raise RecordingError(f"{source}: holds no numeric messages")
    metadata = _metadata(reader)
    parts = [_assemble(part, units, metadata) for part in _forward(samples)] if cut else []
    if len(parts) > 1 and min(len(part) for part in parts) >= LEAST_SEGMENT:
        return parts
    return [_assemble(samples, units, metadata)]


def _forward(samples: Samples) -> list[Samples]:
    """Return the samples before, between and after the instants at which the time of a topic goes back."""
    parts: list[Samples] = []
    for name, (times, values) in samples.items():
        cuts = [0, *(np.flatnonzero(np.diff(times) < 0) + 1).tolist(), len(times)]
        parts += [{} for _ in range(len(cuts) - 1 - len(parts))]
        for part, first, stop in zip(parts, cuts, cuts[1:], strict=False):
            part[name] = times[first:stop], values[first:stop]
    return parts


def _numbers(source: Path, topic: str, data: bytes) -> Iterator[tuple[str, float]]:
    """Yield the column name and value of every number in one message."""
    try:
        message: Any = orjson.loads(data)
    except orjson.JSONDecodeError as error:
        raise RecordingError(f"{source}: topic '{topic}': a message is not JSON ({error.msg})") from error
    if not isinstance(message, dict):
        raise RecordingError(f"{source}: topic '{topic}': a message is not a JSON object")
    for field, value in message.items():
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield (topic if field == VALUE else f"{topic}.{field}"), float(value)


def _metadata(reader: Any) -> dict[str, str]:
    return {key: text for record in reader.iter_metadata() for key, text in record.metadata.items()}


def _assemble(samples: Samples, units: dict[str, str], metadata: dict[str, str]) -> Recording:
    series = {
        name: (np.array(times, dtype=np.int64), np.array(values, dtype=np.float64))
        for name, (times, values) in samples.items()
    }
    aligned = align(series)
    return Recording(aligned.time_ns, aligned.columns, units, metadata, aligned.notices)
