"""Twins: what was registered, and how far their archive reaches."""

import sqlite3
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import orjson

from service.instants import now_us
from service.problems import Problem


@dataclass(frozen=True)
class Twin:
    """A registered twin and the head of its archive."""

    key: int
    name: str
    text: str
    created_us: int
    seq: int
    samples: int
    first_us: int | None
    last_us: int | None
    active_version: int | None
    quarantined: int

    @cached_property
    def specification(self) -> dict[str, Any]:
        """The specification as it was first registered."""
        return dict(orjson.loads(self.text))

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Every telemetry channel, in the order of its values in the archive."""
        return tuple(self.specification["channels"])


_SELECT = """
    SELECT twin.id, twin.name, twin.specification, twin.created_us, head.seq, head.samples, head.first_us, head.last_us,
           (SELECT version FROM activation WHERE activation.twin = twin.id ORDER BY id DESC LIMIT 1),
           (SELECT coalesce(sum(n), 0) FROM aside WHERE aside.twin = twin.id AND deletion IS NULL)
    FROM twin JOIN head ON head.twin = twin.id
"""


def canonical(specification: dict[str, Any]) -> bytes:
    """Return the text by which two specifications are compared: the order of members does not matter."""
    return orjson.dumps(specification, option=orjson.OPT_SORT_KEYS)


def register(connection: sqlite3.Connection, name: str, specification: dict[str, Any]) -> tuple[Twin, bool]:
    """Return the twin, and whether it is new; Problem 409 if the id means another specification already."""
    try:
        known = get(connection, name)
    except Problem:
        text = orjson.dumps(specification).decode()
        values = (name, text, now_us())
        row = connection.execute("INSERT INTO twin (name, specification, created_us) VALUES (?, ?, ?)", values)
        connection.execute("INSERT INTO head (twin) VALUES (?)", (row.lastrowid,))
        return get(connection, name), True
    if canonical(known.specification) != canonical(specification):
        raise Problem(409, f"twin: '{name}' is registered with another specification; delete it or choose another id")
    return known, False


def get(connection: sqlite3.Connection, name: str) -> Twin:
    """Return one twin; Problem 404 if there is none of that name."""
    row = connection.execute(_SELECT + "WHERE twin.name = ?", (name,)).fetchone()
    if row is None:
        raise Problem(404, f"no twin '{name}' is registered")
    return Twin(*row)


def select(connection: sqlite3.Connection) -> list[Twin]:
    """Return every twin, by name."""
    return [Twin(*row) for row in connection.execute(_SELECT + "ORDER BY twin.name")]


def delete(connection: sqlite3.Connection, name: str) -> Twin:
    """Delete a twin with everything that belongs to it; Problem 404 if there is none."""
    twin = get(connection, name)
    connection.execute("DELETE FROM twin WHERE id = ?", (twin.key,))
    return twin
