"""Twins: what was registered, and how far their archive reaches."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import orjson

from service.instants import now_us
from service.store.connection import Connection
from service.store.errors import Conflicting, Missing


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


def register(connection: Connection, name: str, specification: dict[str, Any]) -> tuple[Twin, bool]:
    """Return the twin, and whether it is new; Conflicting if the id means another specification already."""
    try:
        known = get(connection, name)
    except Missing:
        text = orjson.dumps(specification).decode()
        values = (name, text, now_us())
        row = connection.execute("INSERT INTO twin (name, specification, created_us) VALUES (?, ?, ?)", values)
        connection.execute("INSERT INTO head (twin) VALUES (?)", (row.lastrowid,))
        return get(connection, name), True
    if canonical(known.specification) != canonical(specification):
        raise Conflicting(f"twin: '{name}' is registered with another specification; delete it or choose another id")
    return known, False


def get(connection: Connection, name: str) -> Twin:
    """Return one twin; Missing if there is none of that name."""
    row = connection.execute(_SELECT + "WHERE twin.name = ?", (name,)).fetchone()
    if row is None:
        raise Missing(f"no twin '{name}' is registered")
    return Twin(*row)


def select(connection: Connection) -> list[Twin]:
    """Return every twin, by name."""
    return [Twin(*row) for row in connection.execute(_SELECT + "ORDER BY twin.name")]


def delete(connection: Connection, name: str) -> Twin:
    """Delete a twin with everything that belongs to it; Missing if there is none.

    Nobody finds it any more, and its name is free; its rows are removed bit by bit (``retention.sweep_gone``).
    """
    twin = get(connection, name)
    connection.execute("DELETE FROM head WHERE twin = ?", (twin.key,))
    connection.execute("UPDATE twin SET name = '~' || id, gone_us = ? WHERE id = ?", (now_us(), twin.key))
    return twin
