"""Samples that are kept beside the archive: in quarantine, because they lie ahead of the present, or deleted for a day.

Nothing reads them but an operator, who may let them into the archive.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson

from service.instants import format_instant, now_us
from service.store import rewrite, segments
from service.store.batch import Batch
from service.store.connection import Connection
from service.store.errors import Conflicting, Missing
from service.store.merge import ACCEPTED, collapse, merge

UNDO_US = 86_400_000_000
"""So long a deletion can be undone."""
_EVER = 2**62


@dataclass(frozen=True)
class Quarantine:
    """What lies in quarantine: how many samples, and from when to when."""

    samples: int
    first_us: int | None
    last_us: int | None


@dataclass(frozen=True)
class Deletion:
    """A deletion: where (``archive`` or ``quarantine``), what, and whether it was undone."""

    id: int
    at_us: int
    place: str
    start_us: int | None
    stop_us: int | None
    channels: tuple[str, ...] | None
    samples: int
    undone_us: int | None

    @property
    def until_us(self) -> int | None:
        """Until when it can be undone; None if it was."""
        return None if self.undone_us is not None else self.at_us + UNDO_US

    def wire(self) -> dict[str, Any]:
        """Return the deletion as clients see it."""

        def when(instant_us: int | None) -> str | None:
            return None if instant_us is None else format_instant(instant_us)

        return {
            "id": self.id,
            "time": format_instant(self.at_us),
            "place": self.place,
            "start": when(self.start_us),
            "stop": when(self.stop_us),
            "channels": None if self.channels is None else list(self.channels),
            "samples": self.samples,
            "undone": when(self.undone_us),
            "undo_until": when(self.until_us),
        }


def quarantine(connection: Connection, twin: int, batch: Batch) -> None:
    """Put samples into quarantine, each once; of two that disagree about an instant the first one stays."""
    n_channels = batch.values.shape[0]
    span = (int(batch.time_us.min()), int(batch.time_us.max()))
    query = """SELECT time, value, received FROM aside WHERE twin = ? AND deletion IS NULL
               AND last_us >= ? AND first_us <= ?"""
    rows = connection.execute(query, (twin, *span)).fetchall()
    held = segments.joined([segments.unpack(n_channels, *row) for row in rows], n_channels)
    known = collapse(held.time_us, held.values) if held.time_us.size else (held.time_us, held.values)
    new = merge(*known, batch.time_us, batch.values).status == ACCEPTED
    if new.any():
        _put(connection, twin, None, batch.take(new))


def _put(connection: Connection, twin: int, deletion: int | None, batch: Batch) -> None:
    connection.execute(
        """INSERT INTO aside (twin, deletion, n, first_us, last_us, time, received, value)
           VALUES (?, ?, ?, ?, ?, ?, ?, ?)""",
        (
            twin,
            deletion,
            int(batch.time_us.size),
            int(batch.time_us.min()),
            int(batch.time_us.max()),
            np.ascontiguousarray(batch.time_us, dtype="<i8").data,
            np.ascontiguousarray(batch.received, dtype="<i8").data,
            np.ascontiguousarray(batch.values, dtype="<f8").data,
        ),
    )


def quarantined(connection: Connection, twin: int) -> Quarantine:
    """Return what lies in quarantine."""
    query = "SELECT coalesce(sum(n), 0), min(first_us), max(last_us) FROM aside WHERE twin = ? AND deletion IS NULL"
    return Quarantine(*connection.execute(query, (twin,)).fetchone())


def select(connection: Connection, twin: int, n_channels: int, most: int) -> Batch:
    """Return the samples in quarantine in the order of their arrival, at most so many."""
    query = "SELECT n, time, value, received FROM aside WHERE twin = ? AND deletion IS NULL ORDER BY id"
    found: list[Batch] = []
    for n, *blobs in connection.execute(query, (twin,)):
        found.append(segments.unpack(n_channels, *blobs))
        most -= n
        if most <= 0:
            break
    whole = segments.joined(found, n_channels)
    return whole.take(np.arange(whole.time_us.size) < whole.time_us.size + min(most, 0))


def delete(
    connection: Connection,
    twin: int,
    names: Sequence[str],
    start_us: int | None,
    stop_us: int | None,
    channels: Sequence[str] | None,
) -> Deletion:
    """Take a part of the archive out for a day: whole samples, or the values of some channels."""
    rows = None if channels is None else [list(names).index(name) for name in channels]
    span = _span(start_us, stop_us)
    taken = rewrite.take_out(connection, twin, len(names), *span, rows)
    made = _note(connection, twin, "archive", start_us, stop_us, channels, int(taken.time_us.size))
    if taken.time_us.size:
        _put(connection, twin, made.id, taken)
    return made


def discard(connection: Connection, twin: int, n_channels: int, start_us: int | None, stop_us: int | None) -> Deletion:
    """Take samples out of quarantine for a day, and then for ever."""
    found = _leave_quarantine(connection, twin, n_channels, start_us, stop_us)
    made = _note(connection, twin, "quarantine", start_us, stop_us, None, int(found.time_us.size))
    if found.time_us.size:
        _put(connection, twin, made.id, found)
    return made


def release(connection: Connection, twin: int, n_channels: int, start_us: int | None, stop_us: int | None) -> Batch:
    """Take samples out of quarantine and return them: they are to be stored in the archive now."""
    return _leave_quarantine(connection, twin, n_channels, start_us, stop_us)


def _leave_quarantine(
    connection: Connection, twin: int, n_channels: int, start_us: int | None, stop_us: int | None
) -> Batch:
    start, stop = _span(start_us, stop_us)
    query = """SELECT id, time, value, received FROM aside WHERE twin = ? AND deletion IS NULL
               AND last_us >= ? AND first_us < ? ORDER BY id"""
    found = []
    for number, *blobs in connection.execute(query, (twin, start, stop)).fetchall():
        held = segments.unpack(n_channels, *blobs)
        inside = (held.time_us >= start) & (held.time_us < stop)
        found.append(held.take(inside))
        connection.execute("DELETE FROM aside WHERE id = ?", (number,))
        if not inside.all():
            _put(connection, twin, None, held.take(~inside))
    return segments.joined(found, n_channels)


def undo(connection: Connection, twin: int, n_channels: int, number: int) -> tuple[Deletion, Batch]:
    """Return a deletion that is undone now, and the samples that are to be stored in the archive again.

    Raises
    ------
    Missing, Conflicting
        If there is no such deletion; if it was undone or is more than a day old.
    """
    made = next((row for row in deletions(connection, twin) if row.id == number), None)
    if made is None:
        raise Missing(f"there is no deletion {number}")
    if made.until_us is None:
        raise Conflicting(f"deletion {number} was undone already")
    if made.until_us < now_us():
        raise Conflicting(f"deletion {number} is more than a day old: what it deleted is gone")
    back = segments.joined([], n_channels)
    if made.place == "quarantine":
        connection.execute("UPDATE aside SET deletion = NULL WHERE deletion = ?", (number,))
    else:
        query = "SELECT time, value, received FROM aside WHERE deletion = ? ORDER BY id"
        rows = connection.execute(query, (number,)).fetchall()
        back = segments.joined([segments.unpack(n_channels, *row) for row in rows], n_channels)
        connection.execute("DELETE FROM aside WHERE deletion = ?", (number,))
    connection.execute("UPDATE deletion SET undone_us = ? WHERE id = ?", (now_us(), number))
    return next(row for row in deletions(connection, twin) if row.id == number), back


def deletions(connection: Connection, twin: int) -> list[Deletion]:
    """Return every deletion, the newest first."""
    query = """SELECT id, at_us, place, start_us, stop_us, channels, samples, undone_us FROM deletion
               WHERE twin = ? ORDER BY id DESC"""
    found = []
    for number, at_us, place, start_us, stop_us, text, count, undone_us in connection.execute(query, (twin,)):
        channels = None if text is None else tuple(orjson.loads(text))
        found.append(Deletion(number, at_us, place, start_us, stop_us, channels, count, undone_us))
    return found


def expire(connection: Connection) -> int:
    """Forget what was deleted more than a day ago; return how many samples that were. The deletions stay on record."""
    late = "deletion IN (SELECT id FROM deletion WHERE at_us < ?)"
    before_us = now_us() - UNDO_US
    gone = int(connection.execute(f"SELECT coalesce(sum(n), 0) FROM aside WHERE {late}", (before_us,)).fetchone()[0])
    if gone:
        connection.execute(f"DELETE FROM aside WHERE {late}", (before_us,))
    return gone


def _note(
    connection: Connection,
    twin: int,
    place: str,
    start_us: int | None,
    stop_us: int | None,
    channels: Sequence[str] | None,
    n_samples: int,
) -> Deletion:
    """Leave a line that says what was deleted."""
    named = None if channels is None else tuple(channels)
    at_us = now_us()
    row = connection.execute(
        """INSERT INTO deletion (twin, at_us, place, start_us, stop_us, channels, samples)
           VALUES (?, ?, ?, ?, ?, ?, ?) RETURNING id""",
        (twin, at_us, place, start_us, stop_us, None if named is None else orjson.dumps(named).decode(), n_samples),
    )
    return Deletion(int(row.fetchone()[0]), at_us, place, start_us, stop_us, named, n_samples, None)


def _span(start_us: int | None, stop_us: int | None) -> tuple[int, int]:
    return (-_EVER if start_us is None else start_us, _EVER if stop_us is None else stop_us)
