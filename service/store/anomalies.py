"""Anomalies: intervals in which a sensor does not behave as its model says."""

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import orjson

from service.instants import format_instant


@dataclass(frozen=True)
class AnomalyRow:
    """One interval; ``stop_us`` is None while it lasts."""

    id: int
    sensor: str
    kind: str
    start_us: int
    stop_us: int | None
    score: float
    cause: str | None
    version: int

    def wire(self) -> dict[str, Any]:
        """Return the anomaly as clients see it."""
        return {
            "id": self.id,
            "sensor": self.sensor,
            "start": format_instant(self.start_us),
            "stop": None if self.stop_us is None else format_instant(self.stop_us),
            "score": self.score,
            "cause": None if self.cause is None else orjson.loads(self.cause),
            "kind": self.kind,
            "model_version": self.version,
        }


@dataclass(frozen=True)
class Change:
    """What a detector says about one sensor: an interval began, went on or ended."""

    sensor: str
    kind: str
    start_us: int
    stop_us: int | None
    score: float


_SELECT = "SELECT id, sensor, kind, start_us, stop_us, score, cause, version FROM anomaly "


def apply(connection: sqlite3.Connection, twin: int, version: int, changes: Sequence[Change]) -> list[AnomalyRow]:
    """Open, raise or close intervals; return those that changed."""
    changed = []
    for change in changes:
        key = (twin, version, change.sensor, change.kind, change.start_us)
        known = connection.execute(
            "SELECT id FROM anomaly WHERE twin = ? AND version = ? AND sensor = ? AND kind = ? AND start_us = ?", key
        ).fetchone()
        if known is None:
            cursor = connection.execute(
                """INSERT INTO anomaly (twin, version, sensor, kind, start_us, stop_us, score)
                   VALUES (?, ?, ?, ?, ?, ?, ?)""",
                (*key, change.stop_us, change.score),
            )
            row = cursor.lastrowid
        else:
            row = known[0]
            update = "UPDATE anomaly SET stop_us = ?, score = max(score, ?) WHERE id = ?"
            connection.execute(update, (change.stop_us, change.score, row))
        changed.append(AnomalyRow(*connection.execute(_SELECT + "WHERE id = ?", (row,)).fetchone()))
    return changed


def rewind(connection: sqlite3.Connection, twin: int, version: int, after_us: int) -> None:
    """Take back what was said about the time after an instant."""
    connection.execute("DELETE FROM anomaly WHERE twin = ? AND version = ? AND start_us > ?", (twin, version, after_us))
    connection.execute(
        "UPDATE anomaly SET stop_us = NULL WHERE twin = ? AND version = ? AND stop_us > ?", (twin, version, after_us)
    )


def close_others(connection: sqlite3.Connection, twin: int, version: int, at_us: int) -> None:
    """End the open intervals of models that are not active any more."""
    connection.execute(
        """UPDATE anomaly SET stop_us = max(start_us, ?) WHERE twin = ? AND version != ? AND stop_us IS NULL""",
        (at_us, twin, version),
    )


def select(
    connection: sqlite3.Connection, twin: int, start_us: int | None = None, stop_us: int | None = None
) -> list[AnomalyRow]:
    """Return the intervals that touch start <= time < stop, the newest first."""
    start = start_us if start_us is not None else -(2**62)
    stop = stop_us if stop_us is not None else 2**62
    query = _SELECT + "WHERE twin = ? AND start_us < ? AND (stop_us IS NULL OR stop_us >= ?) ORDER BY start_us DESC, id"
    return [AnomalyRow(*row) for row in connection.execute(query, (twin, stop, start))]


def explain(connection: sqlite3.Connection, twin: int, sensors: Sequence[str], cause: dict[str, Any]) -> None:
    """Name the cause of the unexplained anomalies of some sensors."""
    text = orjson.dumps(cause).decode()
    for sensor in sensors:
        query = "UPDATE anomaly SET cause = ? WHERE twin = ? AND sensor = ? AND cause IS NULL"
        connection.execute(query, (text, twin, sensor))


def open_ids(connection: sqlite3.Connection, twin: int, version: int | None) -> list[int]:
    """Return the numbers of the anomalies of one model version that last."""
    query = "SELECT id FROM anomaly WHERE twin = ? AND version = ? AND stop_us IS NULL ORDER BY id"
    return [number for (number,) in connection.execute(query, (twin, version))]
