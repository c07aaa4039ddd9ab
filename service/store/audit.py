"""The audit log: who changed what, and who was refused; it only grows, up to its bound."""

from typing import Any

from service.instants import format_instant
from service.store.connection import Connection

KEPT = 100_000
"""So many of the newest lines are kept."""


def append(
    connection: Connection, at_us: int, who: str, method: str, path: str, status: int, client: str, detail: str
) -> None:
    """Write one line."""
    row = connection.execute(
        "INSERT INTO audit (at_us, who, method, path, status, client, detail) VALUES (?, ?, ?, ?, ?, ?, ?) RETURNING id",
        (at_us, who, method, path, status, client, detail),
    )
    connection.execute("DELETE FROM audit WHERE id <= ?", (int(row.fetchone()[0]) - KEPT,))


def settled(connection: Connection) -> None:
    """Do nothing: whoever waits for this write waits for every line before it."""


def select(connection: Connection, most: int, before: int | None) -> list[dict[str, Any]]:
    """Return the newest lines, or those before one."""
    query = """SELECT id, at_us, who, method, path, status, client, detail FROM audit WHERE id < ?
               ORDER BY id DESC LIMIT ?"""
    names = ("id", "time", "who", "method", "path", "status", "client", "detail")
    found = []
    for row in connection.execute(query, (2**62 if before is None else before, most)):
        found.append(dict(zip(names, row, strict=True)) | {"time": format_instant(row[1])})
    return found
