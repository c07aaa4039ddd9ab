"""Messages of Foxglove as JSON, which its panels know by the names of their schemas.

Source: https://docs.foxglove.dev/docs/sdk/schemas. The log panel shows ``foxglove.Log``, the 3D panel ``foxglove.Grid`` in
colours of one of its fields; ``foxglove.Event`` is an interval with what is known of it.
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.bridges.events import Note, Severity

LOG, EVENT, GRID = "foxglove.Log", "foxglove.Event", "foxglove.Grid"
LOG_TOPIC, EVENT_TOPIC, GRID_TOPIC = "/events", "/intervals", "/field"
LEVELS: Mapping[Severity, int] = {"info": 2, "watch": 3, "warning": 3, "distress": 4, "critical": 5}
"""Severity -> level of a log message: INFO, WARNING, ERROR, FATAL."""
FLOAT32 = 7
"""Numeric type of a packed element."""
FIELD, FRAME = "temperature_K", "section"

Json = dict[str, Any]


@dataclass(frozen=True)
class Picture:
    """A field at one instant.

    Attributes
    ----------
    instant_ns
        Unix nanoseconds.
    temperature_K : (n_rows, n_columns)
        At the centre of each cell, the first row at the bottom; NaN where nothing is.
    origin_m
        Lower left corner.
    cell_m
        Side of a cell.
    """

    instant_ns: int
    temperature_K: NDArray[np.float64]
    origin_m: tuple[float, float]
    cell_m: float


def _object(**properties: Json) -> Json:
    return {"type": "object", "properties": properties}


def _numbers(names: str) -> Json:
    return _object(**{name: {"type": "number"} for name in names})


_TEXT, _COUNT = {"type": "string"}, {"type": "integer", "minimum": 0}
_TIME = {"title": "time", **_object(sec=_COUNT, nsec=_COUNT)}
_BODIES = {
    LOG: _object(timestamp=_TIME, level=_COUNT, message=_TEXT, name=_TEXT, file=_TEXT, line=_COUNT),
    EVENT: _object(
        start_time=_TIME, end_time=_TIME, metadata={"type": "array", "items": _object(key=_TEXT, value=_TEXT)}
    ),
    GRID: _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        pose=_object(position=_numbers("xyz"), orientation=_numbers("xyzw")),
        column_count=_COUNT,
        cell_size=_numbers("xy"),
        row_stride=_COUNT,
        cell_stride=_COUNT,
        fields={"type": "array", "items": _object(name=_TEXT, offset=_COUNT, type=_COUNT)},
        data={"type": "string", "contentEncoding": "base64"},
    ),
}
SCHEMAS: Mapping[str, Json] = {
    name: {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": name, **body}
    for name, body in _BODIES.items()
}
"""Name -> JSON Schema of a message."""


def log_of(note: Note) -> Json:
    """Return an event as a log message."""
    about = {"message": note.message, "name": note.about, "file": "", "line": 0}
    return {"timestamp": _time(1_000_000 * note.time_ms), "level": LEVELS[note.severity], **about}


def event_of(note: Note) -> Json | None:
    """Return what is over, or took no time, as an interval; None of what has only begun."""
    if note.kind in ("ANOMALY", "LIMIT", "LIMIT_FORECAST"):
        return None
    told = {"kind": note.kind, "about": note.about, "severity": note.severity, "message": note.message}
    told |= {"link": note.link} if note.link else {}
    begun_ms = note.time_ms if note.since_ms is None else note.since_ms
    return {
        "start_time": _time(1_000_000 * begun_ms),
        "end_time": _time(1_000_000 * note.time_ms),
        "metadata": [{"key": key, "value": value} for key, value in told.items()],
    }


def grid_of(picture: Picture) -> Json:
    """Return a field as a grid of square cells."""
    n_columns = picture.temperature_K.shape[1]
    x, y = picture.origin_m
    return {
        "timestamp": _time(picture.instant_ns),
        "frame_id": FRAME,
        "pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
        "column_count": n_columns,
        "cell_size": {"x": picture.cell_m, "y": picture.cell_m},
        "row_stride": 4 * n_columns,
        "cell_stride": 4,
        "fields": [{"name": FIELD, "offset": 0, "type": FLOAT32}],
        "data": base64.b64encode(picture.temperature_K.astype("<f4").tobytes()).decode(),
    }


def _time(instant_ns: int) -> Json:
    sec, nsec = divmod(instant_ns, 1_000_000_000)
    return {"sec": sec, "nsec": nsec}
