"""Anomalies: intervals in which a sensor does not behave as its model says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import orjson

from service.instants import format_instant
from service.store import models
from service.store.connection import Connection

WORDS = {
    "residual": "departs from its model",
    "stuck": "is frozen: it repeats one reading",
    "quantised": "repeats its readings more often than it used to",
    "dropout": "does not report while others do",
    "joint": "together depart from their model",
    "family": "is unlike its family",
}
FAMILY = "family"
"""Said of a parameter when a model is made; no residual begins or ends it."""


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
            "message": f"{'all sensors' if self.sensor == '*' else self.sensor} {WORDS.get(self.kind, self.kind)}",
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


NOTICEABLE = 1.1
"""A score is news when it has changed by this factor."""


def apply(
    connection: Connection, twin: int, version: int, changes: Sequence[Change], span_us: tuple[int, int]
) -> list[AnomalyRow]:
    """Write down what a detector says about the instants (after, until]; return the intervals that are news.

    What was said about this time before, until a late sample came, is replaced: an interval that overlaps an earlier one
    of its sensor and kind is the same anomaly and keeps number and cause; earlier ones that nothing confirms go.
    """
    news: list[int] = []
    confirmed: set[int] = set()
    for change in sorted(changes, key=lambda change: change.start_us):
        known = _same(connection, twin, version, change, span_us[0], confirmed)
        if known is None:
            cursor = connection.execute(
                """INSERT INTO anomaly (twin, version, sensor, kind, start_us, stop_us, score, cause)
                   VALUES (?, ?, ?, ?, ?, ?, ?, ?) RETURNING id""",
                (
                    *(twin, version, change.sensor, change.kind, change.start_us, change.stop_us, change.score),
                    _known_cause(connection, twin, version, change),
                ),
            )
            number = int(cursor.fetchone()[0])
        else:
            number = known.id
            confirmed.add(number)
            ratio = max(change.score, 1e-9) / max(known.score, 1e-9)
            same = (known.start_us, known.stop_us) == (change.start_us, change.stop_us)
            if same and 1.0 / NOTICEABLE < ratio < NOTICEABLE:
                continue
            update = "UPDATE anomaly SET start_us = ?, stop_us = ?, score = ? WHERE id = ?"
            connection.execute(update, (change.start_us, change.stop_us, change.score, number))
        confirmed.add(number)
        news.append(number)
    kept = ",".join(map(str, confirmed or {0}))
    connection.execute(
        f"""DELETE FROM anomaly WHERE twin = ? AND version = ? AND kind <> '{FAMILY}' AND start_us > ? AND start_us <= ?
            AND id NOT IN ({kept})""",
        (twin, version, *span_us),
    )
    return [
        AnomalyRow(*connection.execute(_SELECT + "WHERE id = ?", (number,)).fetchone())
        for number in dict.fromkeys(news)
    ]


def close(connection: Connection, twin: int, version: int, stop_us: int, until_us: int) -> list[AnomalyRow]:
    """End the intervals that began before ``until_us`` and last: nothing is known of what followed ``stop_us`` there."""
    query = f"""UPDATE anomaly SET stop_us = CASE WHEN start_us > ? THEN start_us ELSE ? END
               WHERE twin = ? AND version = ? AND kind <> '{FAMILY}' AND stop_us IS NULL AND start_us < ?
               RETURNING id, sensor, kind, start_us, stop_us, score, cause, version"""
    return [
        AnomalyRow(*row) for row in connection.execute(query, (stop_us, stop_us, twin, version, until_us)).fetchall()
    ]


def tell_family(
    connection: Connection, twin: int, version: int, start_us: int, differs: Mapping[str, float]
) -> list[AnomalyRow]:
    """Write down in which parameters a model is unlike its family, with two-sided p-values; scores are in standard deviations."""
    query = """INSERT INTO anomaly (twin, version, sensor, kind, start_us, stop_us, score, cause)
               VALUES (?, ?, ?, ?, ?, NULL, ?, NULL) RETURNING id, sensor, kind, start_us, stop_us, score, cause, version"""
    return [
        AnomalyRow(
            *connection.execute(
                query, (twin, version, parameter, FAMILY, start_us, -NormalDist().inv_cdf(max(p, 1e-300) / 2.0))
            ).fetchone()
        )
        for parameter, p in differs.items()
    ]


def _same(
    connection: Connection, twin: int, version: int, change: Change, after_us: int, taken: set[int]
) -> AnomalyRow | None:
    """Return the anomaly that a change goes on with: of the same start, or else said of a later time and overlapping."""
    until_us = 2**62 if change.stop_us is None else change.stop_us
    query = """WHERE twin = ? AND version = ? AND sensor = ? AND kind = ? AND (start_us = ? OR
        (start_us > ? AND start_us <= ? AND (stop_us IS NULL OR stop_us >= ?))) ORDER BY start_us != ?, start_us"""
    start = change.start_us
    place = (twin, version, change.sensor, change.kind)
    rows = connection.execute(_SELECT + query, (*place, start, after_us, until_us, start, start))
    found = (AnomalyRow(*row) for row in rows)
    return next((row for row in found if row.id not in taken or row.start_us == change.start_us), None)


def select(
    connection: Connection,
    twin: int,
    start_us: int | None = None,
    stop_us: int | None = None,
    version: int | None = None,
) -> list[AnomalyRow]:
    """Return the intervals that touch start <= time < stop, of the active model or of another: what lasts first, then the newest.

    What lasted when a model was last followed counts as ended there.
    """
    start = start_us if start_us is not None else -(2**62)
    stop = stop_us if stop_us is not None else 2**62
    active = models.active_version(connection, twin)
    chosen = active if version is None else version
    query = _SELECT + "WHERE twin = ? AND version = ? AND start_us < ? ORDER BY stop_us IS NULL DESC, start_us DESC, id"
    rows = [AnomalyRow(*row) for row in connection.execute(query, (twin, chosen, stop))]
    if chosen != active:
        last = connection.execute("SELECT max(time_us) FROM checkpoint WHERE twin = ? AND version = ?", (twin, chosen))
        end = last.fetchone()[0]
        rows = [replace(r, stop_us=max(r.start_us, end or 0)) if r.stop_us is None else r for r in rows]
    return [row for row in rows if row.stop_us is None or row.stop_us >= start]


OF_THE_MODEL = ("residual", "joint")
"""Kinds that say that the model is off; the others are seen in the readings alone, and no missing heat explains them."""


def explain(
    connection: Connection,
    twin: int,
    sensors: Sequence[str],
    cause: dict[str, Any],
    span_us: tuple[int | None, int | None],
) -> None:
    """Name the cause of the unexplained anomalies of some sensors in the time (first, last) in which it was found."""
    first_us, last_us = span_us
    text = orjson.dumps(cause).decode()
    query = f"""UPDATE anomaly SET cause = ? WHERE twin = ? AND cause IS NULL AND kind IN {OF_THE_MODEL}
                AND start_us <= ? AND coalesce(stop_us, ?) >= ? AND sensor = ?"""
    span = (2**62 if last_us is None else last_us, 2**62, -(2**62) if first_us is None else first_us)
    connection.executemany(query, [(text, twin, *span, sensor) for sensor in sensors])


def _known_cause(connection: Connection, twin: int, version: int, change: Change) -> str | None:
    """Return the cause that the same anomaly has under another model, unless the model at hand has that effect already."""
    if change.kind not in OF_THE_MODEL:
        return None
    query = """SELECT cause FROM anomaly WHERE twin = ? AND sensor = ? AND kind = ? AND cause IS NOT NULL
               AND start_us <= ? AND coalesce(stop_us, ?) >= ? ORDER BY id DESC LIMIT 1"""
    until_us = 2**62 if change.stop_us is None else change.stop_us
    place = (twin, change.sensor, change.kind, until_us, 2**62, change.start_us)
    row = connection.execute(query, place).fetchone()
    if row is None:
        return None
    cause = orjson.loads(row[0])
    query = "SELECT summary FROM model WHERE twin = ? AND version = ?"
    summary = connection.execute(query, (twin, version)).fetchone()
    effects = [] if summary is None else orjson.loads(summary[0]).get("effects", [])
    has_it = any((e["effect"], e["where"]) == (cause["effect"], cause["where"]) for e in effects)
    return None if has_it else str(row[0])


def open_kinds(connection: Connection, twin: int, version: int | None) -> dict[str, list[str]]:
    """Return the kinds of anomalies of one model version that last, by sensor."""
    query = """SELECT sensor, kind FROM anomaly WHERE twin = ? AND version = ? AND stop_us IS NULL
               GROUP BY sensor, kind ORDER BY min(id)"""
    found: dict[str, list[str]] = {}
    for sensor, kind in connection.execute(query, (twin, version)):
        found.setdefault(sensor, []).append(kind)
    return found


def open_since(connection: Connection, twin: int) -> list[int]:
    """Return when the departures from the active model that last began."""
    query = """SELECT start_us FROM anomaly WHERE twin = ? AND version = ? AND stop_us IS NULL AND kind IN ('residual', 'joint')
               ORDER BY start_us"""
    return [int(row[0]) for row in connection.execute(query, (twin, models.active_version(connection, twin)))]
