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
    revision: int = 1

    @cached_property
    def specification(self) -> dict[str, Any]:
        """The specification as it is now, with its channels in the order of the archive."""
        return dict(orjson.loads(self.text))

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Every telemetry channel, in the order of its values in the archive."""
        return tuple(self.specification["channels"])


_SELECT = """
    SELECT twin.id, twin.name, twin.specification, twin.created_us, head.seq, head.samples, head.first_us, head.last_us,
           (SELECT version FROM activation WHERE activation.twin = twin.id ORDER BY id DESC LIMIT 1),
           (SELECT coalesce(sum(n), 0) FROM aside WHERE aside.twin = twin.id AND deletion IS NULL),
           twin.revision
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
        query = (
            "INSERT INTO twin (name, specification, created_us) VALUES (?, ?, ?) ON CONFLICT DO NOTHING RETURNING id"
        )
        row = connection.execute(query, values).fetchone()
        if row is None:  # another process registered it just now
            return register(connection, name, specification)
        connection.execute("INSERT INTO head (twin) VALUES (?)", row)
        return get(connection, name), True
    if canonical(known.specification) != canonical(specification):
        raise Conflicting(
            f"twin: '{name}' is registered with another specification; PUT changes it, or choose another id"
        )
    return known, False


def revise(connection: Connection, name: str, specification: dict[str, Any]) -> tuple[Twin, bool]:
    """Give a twin another specification; return it, and whether anything changed. The former one stays on record.

    Raises
    ------
    Missing, Conflicting
        If there is no such twin; if a channel is gone or has another kind or unit, since the archive goes on.
    """
    known = get(connection, name)
    if canonical(known.specification) == canonical(specification):
        return known, False
    channels = specification["channels"]
    for channel, declared in known.specification["channels"].items():
        if channel not in channels:
            raise Conflicting(
                f"channels: '{channel}' is missing; its samples are in the archive: declare it, though nothing needs to use it",
                [("channels", f"'{channel}' is missing")],
            )
        for field in ("kind", "unit", "levels"):
            if channels[channel].get(field) != declared.get(field):
                what = f"is {channels[channel].get(field)}, the archive's is {declared.get(field)}"
                raise Conflicting(f"channels.{channel}.{field}: {what}", [(f"channels.{channel}.{field}", what)])
    order = [*known.channels, *(c for c in channels if c not in known.channels)]
    text = orjson.dumps({**specification, "channels": {c: channels[c] for c in order}}).decode()
    values = (known.key, known.revision, now_us(), known.text)
    connection.execute("INSERT INTO revision (twin, number, at_us, specification) VALUES (?, ?, ?, ?)", values)
    connection.execute("UPDATE twin SET specification = ?, revision = revision + 1 WHERE id = ?", (text, known.key))
    return get(connection, name), True


def revisions(connection: Connection, twin: int) -> list[tuple[int, int, dict[str, Any]]]:
    """Return the former specifications of a twin as (number, until when, specification), the newest first."""
    query = "SELECT number, at_us, specification FROM revision WHERE twin = ? ORDER BY number DESC"
    return [(number, at_us, orjson.loads(text)) for number, at_us, text in connection.execute(query, (twin,))]


def get(connection: Connection, name: str) -> Twin:
    """Return one twin; Missing if there is none of that name."""
    row = connection.execute(_SELECT + "WHERE twin.name = ?", (name,)).fetchone()
    if row is None:
        raise Missing(f"no twin '{name}' is registered")
    return Twin(*row)


def mark(connection: Connection, name: str) -> tuple[int, int]:
    """Return the number and the revision of a twin, which tell whether what is known of it still holds; Missing if it is gone."""
    row = connection.execute("SELECT id, revision FROM twin WHERE name = ?", (name,)).fetchone()
    if row is None:
        raise Missing(f"no twin '{name}' is registered")
    return int(row[0]), int(row[1])


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
