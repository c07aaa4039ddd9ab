"""Checkpoints: states of the assimilation, from which it goes on after a restart or before a late sample."""

from dataclasses import dataclass
from typing import Any

import orjson

from service.store.connection import Connection

EVERY = 500
"""Of older checkpoints one is kept for about so many samples."""
MOST = 400
"""When there are more, every other one of the older half goes."""


@dataclass(frozen=True)
class Checkpoint:
    """Where an assimilation stood after the sample at ``time_us``."""

    time_us: int
    n_samples: int
    body: dict[str, Any]


def put(
    connection: Connection, twin: int, version: int, checkpoint: Checkpoint, *, keep_previous: bool = False
) -> None:
    """Store a checkpoint, and forget the previous one unless it is worth keeping."""
    rows = connection.execute(
        "SELECT time_us, n FROM checkpoint WHERE twin = ? AND version = ? AND time_us < ? ORDER BY time_us DESC LIMIT 2",
        (twin, version, checkpoint.time_us),
    ).fetchall()
    if not keep_previous and len(rows) == 2 and checkpoint.n_samples - rows[1][1] < EVERY:
        _delete(connection, twin, version, [rows[0][0]])
    connection.execute(
        """INSERT INTO checkpoint (twin, version, time_us, n, state) VALUES (?, ?, ?, ?, ?)
           ON CONFLICT (twin, version, time_us) DO UPDATE SET n = excluded.n, state = excluded.state""",
        (twin, version, checkpoint.time_us, checkpoint.n_samples, orjson.dumps(checkpoint.body).decode()),
    )
    _thin(connection, twin, version)


def _thin(connection: Connection, twin: int, version: int) -> None:
    query = "SELECT time_us FROM checkpoint WHERE twin = ? AND version = ? ORDER BY time_us"
    times = [time_us for (time_us,) in connection.execute(query, (twin, version))]
    if len(times) > MOST:
        _delete(connection, twin, version, times[1 : MOST // 2 : 2])


def _delete(connection: Connection, twin: int, version: int, times: list[int]) -> None:
    query = "DELETE FROM checkpoint WHERE twin = ? AND version = ? AND time_us = ?"
    connection.executemany(query, [(twin, version, time_us) for time_us in times])


def before(connection: Connection, twin: int, version: int, time_us: int | None = None) -> Checkpoint | None:
    """Return the last checkpoint before an instant, or the last of all."""
    row = connection.execute(
        """SELECT time_us, n, state FROM checkpoint WHERE twin = ? AND version = ? AND time_us < ?
           ORDER BY time_us DESC LIMIT 1""",
        (twin, version, 2**62 if time_us is None else time_us),
    ).fetchone()
    return None if row is None else Checkpoint(row[0], row[1], orjson.loads(row[2]))


def floor(connection: Connection, twin: int, version: int) -> int | None:
    """Return the first instant that a version's assimilation looks at; None: it begins with the archive."""
    query = "SELECT at_us FROM floor WHERE twin = ? AND version = ?"
    row = connection.execute(query, (twin, version)).fetchone()
    return None if row is None else int(row[0])


def raise_floor(connection: Connection, twin: int, version: int, at_us: int) -> None:
    """Let a version's assimilation look at nothing before an instant from now on."""
    query = """INSERT INTO floor (twin, version, at_us) VALUES (?, ?, ?)
               ON CONFLICT (twin, version) DO UPDATE SET at_us = excluded.at_us"""
    connection.execute(query, (twin, version, at_us))


def forget(connection: Connection, twin: int, version: int, after_us: int, until_us: int) -> None:
    """Forget the checkpoints after < time < until: they did not know of a late sample."""
    query = "DELETE FROM checkpoint WHERE twin = ? AND version = ? AND time_us > ? AND time_us < ?"
    connection.execute(query, (twin, version, after_us, until_us))
