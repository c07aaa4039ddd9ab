"""Events of a twin's stream that are not samples: jobs, models, anomalies, each with its number."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import orjson

from service.store import webhooks
from service.store.connection import Connection
from service.store.errors import TwinGone


@dataclass(frozen=True)
class Event:
    """One message of a stream in the making: its number, its time and what it says."""

    seq: int
    time_us: int
    type: str
    body: dict[str, Any]


def claim(connection: Connection, twin: int, count: int) -> int:
    """Reserve ``count`` consecutive numbers of a twin's stream; return the first."""
    row = connection.execute("UPDATE head SET seq = seq + ? WHERE twin = ? RETURNING seq", (count, twin)).fetchone()
    if row is None:
        raise TwinGone(f"twin {twin} is gone")
    return int(row[0]) - count + 1


def append(
    connection: Connection, twin: int, time_us: int, messages: Sequence[tuple[str, dict[str, Any]]]
) -> list[Event]:
    """Store messages given as (type, body) and return them with their numbers."""
    first = claim(connection, twin, len(messages))
    events = [Event(first + i, time_us, kind, body) for i, (kind, body) in enumerate(messages)]
    rows = [(twin, event.seq, time_us, event.type, orjson.dumps(event.body).decode()) for event in events]
    connection.executemany("INSERT INTO event (twin, seq, time_us, type, body) VALUES (?, ?, ?, ?, ?)", rows)
    for event in events:
        webhooks.enqueue(connection, twin, event.seq, time_us, event.type, event.body)
    return events


def since_seq(connection: Connection, twin: int, after_seq: int) -> list[Event]:
    """Return the events after one number, in order."""
    query = "SELECT seq, time_us, type, body FROM event WHERE twin = ? AND seq > ? ORDER BY seq"
    return [
        Event(seq, time_us, kind, orjson.loads(body))
        for seq, time_us, kind, body in connection.execute(query, (twin, after_seq))
    ]
