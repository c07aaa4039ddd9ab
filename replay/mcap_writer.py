"""Writing MCAP files sample by sample: one topic per telemetry channel, JSON with a JSON Schema, log time = sample time."""

import contextlib
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import orjson
from mcap.writer import Writer

from replay.bridges.events import Note
from replay.bridges.foxglove_messages import (
    EVENT,
    EVENT_TOPIC,
    GRID,
    GRID_TOPIC,
    LOG,
    LOG_TOPIC,
    SCHEMAS,
    Picture,
    event_of,
    grid_of,
    log_of,
)
from replay.errors import RecordingError

METADATA_NAME = "thermal-twin"
SCHEMA_NAME = "thermal_twin.Sample"
VALUE = "value"


def sample_schema(topic: str, unit: str | None) -> dict[str, Any]:
    """Return the JSON Schema of one topic's samples. Viewers look schemas up by name, and each topic has its own unit."""
    about = {"type": "number", "description": f"{topic} in {unit}" if unit else topic} | (
        {"unit": unit} if unit else {}
    )
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"{SCHEMA_NAME}.{topic}",
        "type": "object",
        "properties": {VALUE: about},
        "required": [VALUE],
    }


def sample_bytes(value: float) -> bytes:
    """Return one sample as a message."""
    return b'{"value":%b}' % orjson.dumps(value)


class McapWriter:
    """An MCAP file in the making. Use it as a context manager: the file appears whole when it ends, or not at all.

    ``attachments``, file name -> content, tell what the channels are: the specification, or the scenario. ``keep`` lets the file
    appear even if an error ends it: a recording of what happened is worth having up to there.
    """

    def __init__(
        self,
        path: Path | str,
        topics: Iterable[str],
        units: Mapping[str, str] | None = None,
        metadata: Mapping[str, str] | None = None,
        *,
        attachments: Mapping[str, bytes] | None = None,
        keep: bool = False,
    ) -> None:
        """Prepare to write ``topics``; RecordingError on entry if the file cannot be written."""
        self._target, self._keep = Path(path), keep
        self._partial = self._target.with_name(f".{self._target.name}.{os.getpid()}.partial")
        self._topics, self._units, self._metadata = list(topics), dict(units or {}), dict(metadata or {})
        self._attachments = dict(attachments or {})
        self._channels: dict[str, int] = {}
        self.count = 0

    def __enter__(self) -> Self:
        """Open the file beside its later place."""
        try:
            self._stream = self._partial.open("wb")
        except OSError as error:
            raise self._refusal(error) from error
        self._writer = Writer(self._stream)
        self._writer.start(profile="", library="thermal-twin")
        if self._metadata:
            self._writer.add_metadata(METADATA_NAME, self._metadata)
        for name, data in self._attachments.items():
            media = "application/json" if name.endswith(".json") else "application/yaml"
            self._writer.add_attachment(0, 0, name, media, data)
        self._channels = {topic: self._add_channel(topic) for topic in self._topics}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the file in its place, or leave nothing behind."""
        try:
            with self._stream:
                self._writer.finish()
            if kind is None or (self._keep and self.count):
                os.replace(self._partial, self._target)
        except OSError as error:
            raise self._refusal(error) from error
        finally:
            with contextlib.suppress(OSError):
                self._partial.unlink(missing_ok=True)

    def add(self, topic: str, instant_ns: int, value: float) -> None:
        """Write one sample; NaN, the missing sample, writes nothing.

        Raises
        ------
        RecordingError
            If the instant is before 1970, the value infinite, or the disk full.
        """
        if math.isnan(value):
            return
        if math.isinf(value) or instant_ns < 0:
            wrong = "is infinite" if math.isinf(value) else "has a time before 1970, which MCAP cannot express"
            raise RecordingError(f"{self._target}: a sample of channel '{topic}' {wrong}")
        self._put(topic, instant_ns, sample_bytes(value))
        self.count += 1

    def tell(self, note: Note) -> None:
        """Write an event as a log message and, once it is over, as an interval; RecordingError as of ``add``."""
        if min(note.time_ms, note.since_ms or 0) < 0:
            raise RecordingError(f"{self._target}: an event has a time before 1970, which MCAP cannot express")
        self._message(LOG_TOPIC, LOG, 1_000_000 * note.time_ms, log_of(note))
        interval = event_of(note)
        if interval is not None:
            self._message(EVENT_TOPIC, EVENT, 1_000_000 * note.time_ms, interval)

    def picture(self, picture: Picture) -> None:
        """Write a field as a grid; RecordingError as of ``add``."""
        self._message(GRID_TOPIC, GRID, picture.instant_ns, grid_of(picture))

    def _message(self, topic: str, schema: str, instant_ns: int, body: Mapping[str, Any]) -> None:
        if topic not in self._channels:
            number = self._writer.register_schema(schema, "jsonschema", orjson.dumps(SCHEMAS[schema]))
            self._channels[topic] = int(self._writer.register_channel(topic, "json", number))
        self._put(topic, instant_ns, orjson.dumps(body))

    def _put(self, topic: str, instant_ns: int, data: bytes) -> None:
        try:
            self._writer.add_message(
                self._channels[topic], instant_ns, data, publish_time=instant_ns, sequence=self.count
            )
        except OSError as error:
            raise self._refusal(error) from error

    def _add_channel(self, topic: str) -> int:
        """Register one topic and its schema; return the channel's number."""
        unit = self._units.get(topic)
        schema = sample_schema(topic, unit)
        schema_id = self._writer.register_schema(schema["title"], "jsonschema", orjson.dumps(schema))
        return int(self._writer.register_channel(topic, "json", schema_id, {"unit": unit} if unit else {}))

    def _refusal(self, error: OSError) -> RecordingError:
        return RecordingError(f"{self._target}: cannot be written ({error.strerror or error})")
