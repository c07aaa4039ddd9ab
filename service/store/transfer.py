"""Moving everything from one database to another: SQLite to PostgreSQL, back, or between two of a kind; checked by digests."""

import hashlib
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.errors import Refusal
from service.store.connection import Connection
from service.store.database import open_engine
from service.store.engine import Engine
from service.store.errors import StoreError
from service.store.segments import make_room

TABLES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "twin": (("id",), ("id", "name", "specification", "created_us", "gone_us", "revision", "retention")),
    "head": (
        ("twin",),
        ("twin", "seq", "samples", "first_us", "last_us", "small_chunks", "small_rows", "revision", "reach_us"),
    ),
    "chunk": (("id",), ("id", "twin", "n", "first_us", "last_us", "last_seq", "seq", "time", "value", "received")),
    "chunk_outline": (("chunk",), ("chunk", "instants", "time", "value")),
    "model": (("twin", "version"), ("twin", "version", "created_us", "source", "summary", "document")),
    "activation": (("id",), ("id", "twin", "version", "at_us", "reason")),
    "job": (
        ("number",),
        (
            *("number", "id", "twin", "kind", "state", "progress", "message", "request", "created_us", "started_us"),
            *("finished_us", "result", "page", "attempt", "worker", "beat_us", "cancel", "returned"),
        ),
    ),
    "event": (("twin", "seq"), ("twin", "seq", "time_us", "type", "body")),
    "residual": (
        ("id",),
        ("id", "twin", "version", "n", "first_us", "last_us", "last_seq", "seq", "time", "value", "n_rows"),
    ),
    "residual_outline": (("chunk",), ("chunk", "instants", "time", "value")),
    "checkpoint": (("twin", "version", "time_us"), ("twin", "version", "time_us", "n", "state")),
    "floor": (("twin", "version"), ("twin", "version", "at_us")),
    "anomaly": (("id",), ("id", "twin", "sensor", "kind", "start_us", "stop_us", "score", "cause", "version")),
    "deletion": (
        ("id",),
        ("id", "twin", "at_us", "place", "start_us", "stop_us", "channels", "samples", "undone_us"),
    ),
    "aside": (("id",), ("id", "twin", "deletion", "n", "first_us", "last_us", "time", "received", "value")),
    "alarm": (
        ("id",),
        (
            *("id", "twin", "origin", "channel", "colour", "side", "bound", "start_us", "stop_us", "body"),
            *("acknowledged_us", "note", "shelved_until_us"),
        ),
    ),
    "vital": (("twin",), ("twin", "version", "time_us", "sensor", "residual_K", "deviations")),
    "watched": (("twin",), ("twin", "seq", "state")),
    "revision": (("twin", "number"), ("twin", "number", "at_us", "specification")),
    "audit": (("id",), ("id", "at_us", "who", "method", "path", "status", "client", "detail")),
    "webhook": (("id",), ("id", "url", "secret", "twins", "types", "created_us")),
    "delivery": (
        ("id",),
        ("id", "webhook", "created_us", "type", "body", "attempts", "next_us", "state", "reason"),
    ),
}
"""Table -> key, columns; in an order in which what is referred to comes first."""
PAGE = 64
"""So many rows, of up to some megabytes each, are in memory at a time."""


@dataclass(frozen=True)
class Moved:
    """One table: how many rows, and the SHA-256 of their values in the order of the key."""

    table: str
    rows: int
    sha256: str


def transfer(
    source: Path | str, target: Path | str, names: tuple[str, str] = ("the source", "the target")
) -> list[Moved]:
    """Copy everything in one transaction, read it back and compare digests; the source stays as it is.

    Parameters
    ----------
    source, target
        Files of SQLite or URLs of PostgreSQL.
    names
        What errors call the two.

    Raises
    ------
    StoreError
        If a database cannot be opened or used, or a service or a worker is at work on it; if the target is not empty, or
        what was written is not what was read.
    """
    if isinstance(source, Path) and not source.is_file():
        raise StoreError(f"{source}: there is no such file")
    origin = open_engine(source, names[0])
    try:
        goal = open_engine(target, names[1])
        try:
            return origin.read(lambda connection: _copy(connection, origin, goal, names))
        except Exception as error:
            if not isinstance(error, (*origin.faults, *goal.faults, Refusal)):
                raise
            told = goal.refusal(error)
            reason = told.detail if isinstance(told, Refusal) else type(told).__name__
            raise StoreError(f"the copy was interrupted, nothing was kept: {reason}") from error
        finally:
            goal.close()
    finally:
        origin.close()


def _copy(connection: Connection, origin: Engine, goal: Engine, names: tuple[str, str]) -> list[Moved]:
    session = goal.session()
    try:
        session.begin(())
        for engine, end, name in ((origin, connection, names[0]), (goal, session.connection, names[1])):
            if engine.is_attended(end):
                raise StoreError(f"{name}: a service or a worker is at work on it; stop all of them first")
        for table in TABLES:
            if session.connection.execute(f"SELECT 1 FROM {table} LIMIT 1").fetchone() is not None:
                raise StoreError(f"{names[1]}: is not empty; name a database that holds nothing yet")
        made = []
        for table in TABLES:
            read = _Digest()
            for page in read.pages(connection, table):
                if table == "chunk":
                    make_room(session.connection, [row[3] for row in page])
                _insert(session.connection, table, page)
            written = _Digest()
            for _ in written.pages(session.connection, table):
                pass
            if (read.rows, read.text) != (written.rows, written.text):
                raise StoreError(f"table {table}: what was written is not what was read; nothing was kept")
            made.append(Moved(table, read.rows, read.text))
        goal.after_transfer(session.connection, {table: key[0] for table, (key, _) in TABLES.items() if key in OWN})
        session.commit()
        return made
    finally:
        session.roll_back()
        session.close()


OWN = (("id",), ("number",))
"""Keys that the database itself hands out."""


def _insert(connection: Connection, table: str, rows: Sequence[tuple[Any, ...]]) -> None:
    columns = TABLES[table][1]
    places = ", ".join("?" for _ in columns)
    connection.executemany(f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({places})", rows)


class _Digest:
    """Reads a table in pages and keeps a fingerprint of what it saw."""

    def __init__(self) -> None:
        self.rows, self._hash = 0, hashlib.sha256()

    @property
    def text(self) -> str:
        """The fingerprint."""
        return self._hash.hexdigest()

    def pages(self, connection: Connection, table: str) -> Iterator[list[tuple[Any, ...]]]:
        """Yield the rows of a table in the order of its key."""
        key, columns = TABLES[table]
        names, order = ", ".join(columns), ", ".join(key)
        last: tuple[Any, ...] = ()
        while True:
            where = f"WHERE ({order}) > ({', '.join('?' for _ in key)}) " if last else ""
            query = f"SELECT {names} FROM {table} {where}ORDER BY {order} LIMIT {PAGE}"
            page = connection.execute(query, last).fetchall()
            if not page:
                return
            for row in page:
                self._see(row)
            last = tuple(page[-1][columns.index(name)] for name in key)
            yield page

    def _see(self, row: tuple[Any, ...]) -> None:
        self.rows += 1
        for value in row:
            match value:
                case None:
                    self._hash.update(b"n")
                case float():
                    self._hash.update(b"f" + struct.pack("<d", value))
                case int():
                    self._hash.update(b"i%d;" % value)
                case str():
                    text = value.encode()
                    self._hash.update(b"s%d;" % len(text) + text)
                case _:
                    self._hash.update(b"b%d;" % len(value) + bytes(value))
