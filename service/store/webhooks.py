"""Webhooks: who wants to hear of what, and each delivery until it was taken or given up.

A delivery is written in the transaction of the event that it tells of, so that none is lost.
"""

import secrets
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import orjson

from service.instants import format_instant, now_us
from service.store.connection import Connection
from service.store.errors import Missing

Json = dict[str, Any]
Topic = Literal["anomaly", "limit", "stale", "model", "job_failed"]
State = Literal["waiting", "delivered", "dead"]
KEPT = 10_000
"""Deliveries that ended are kept up to this number, the newest."""


@dataclass(frozen=True)
class Webhook:
    """Where to send what; ``twins`` and ``types`` None: all of them."""

    id: int
    url: str
    secret: str
    twins: tuple[str, ...] | None
    types: tuple[str, ...] | None
    created_us: int

    def wire(self) -> Json:
        """Return it as clients see it, without its secret."""
        return {
            "id": self.id,
            "url": self.url,
            "twins": None if self.twins is None else list(self.twins),
            "types": None if self.types is None else list(self.types),
            "created": format_instant(self.created_us),
        }


@dataclass(frozen=True)
class Delivery:
    """One message on its way; ``next_us`` is when it is tried again."""

    id: int
    webhook: int
    created_us: int
    type: str
    body: str
    attempts: int
    next_us: int | None
    state: State
    reason: str

    def wire(self) -> Json:
        """Return it as clients see it."""
        return {
            "id": self.id,
            "webhook": self.webhook,
            "created": format_instant(self.created_us),
            "event": self.type,
            "state": self.state,
            "attempts": self.attempts,
            "next": None if self.next_us is None else format_instant(self.next_us),
            "reason": self.reason,
            "body": orjson.loads(self.body),
        }


_HOOKS = "SELECT id, url, secret, twins, types, created_us FROM webhook "
_DELIVERIES = "SELECT id, webhook, created_us, type, body, attempts, next_us, state, reason FROM delivery "


def _hook(row: tuple[Any, ...]) -> Webhook:
    names = [None if text is None else tuple(orjson.loads(text)) for text in row[3:5]]
    return Webhook(row[0], row[1], row[2], names[0], names[1], row[5])


def add(
    connection: Connection,
    url: str,
    twins: Collection[str] | None,
    types: Collection[str] | None,
    secret: str | None = None,
) -> Webhook:
    """Store a webhook; without a secret it is given one."""
    texts = [None if names is None else orjson.dumps(sorted(names)).decode() for names in (twins, types)]
    row = connection.execute(
        "INSERT INTO webhook (url, secret, twins, types, created_us) VALUES (?, ?, ?, ?, ?) RETURNING id",
        (url, secret or secrets.token_hex(32), *texts, now_us()),
    )
    return get(connection, int(row.fetchone()[0]))


def get(connection: Connection, number: int) -> Webhook:
    """Return one webhook; Missing if there is none of that number."""
    row = connection.execute(_HOOKS + "WHERE id = ?", (number,)).fetchone()
    if row is None:
        raise Missing(f"there is no webhook {number}")
    return _hook(row)


def select(connection: Connection) -> list[Webhook]:
    """Return every webhook."""
    return [_hook(row) for row in connection.execute(_HOOKS + "ORDER BY id")]


def remove(connection: Connection, number: int) -> Webhook:
    """Delete a webhook with its deliveries and return it; Missing if there is none of that number."""
    hook = get(connection, number)
    connection.execute("DELETE FROM webhook WHERE id = ?", (number,))
    return hook


def enqueue(connection: Connection, twin: int, seq: int, time_us: int, kind: str, body: Mapping[str, Any]) -> None:
    """Queue a message of a twin's stream for every webhook that wants it."""
    hooks = select(connection)
    told = _told(kind, body) if hooks else None
    if told is None:
        return
    topic, level, text = told
    name = connection.execute("SELECT name FROM twin WHERE id = ?", (twin,)).fetchone()[0]
    document = {
        "event": topic,
        "twin": name,
        "seq": seq,
        "time": format_instant(time_us),
        "title": f"{name}: {text}"[:200],
        "body": text,
        "type": level,
        "message": dict(body),
    }
    for hook in hooks:
        if (hook.twins is None or name in hook.twins) and (hook.types is None or topic in hook.types):
            connection.execute(
                "INSERT INTO delivery (webhook, created_us, type, body, next_us) VALUES (?, ?, ?, ?, ?)",
                (hook.id, now_us(), topic, orjson.dumps(document).decode(), now_us()),
            )


def _told(kind: str, body: Mapping[str, Any]) -> tuple[Topic, str, str] | None:
    """Return what a message of the stream is to webhooks: topic, how bad it is and a line of text; None if it is nothing."""
    if kind == "anomaly":
        anomaly = body["anomaly"]
        ended = anomaly["stop"] is not None
        return "anomaly", "info" if ended else "warning", f"{anomaly['message']}{' (ended)' if ended else ''}"
    if kind == "alarm":
        alarm = body["alarm"]
        if alarm["shelved_until"] is not None:
            return None
        level = "info" if alarm["stop"] is not None else "failure" if alarm["colour"] == "red" else "warning"
        return "limit", level, f"{alarm['message']}{' (ended)' if alarm['stop'] is not None else ''}"
    if kind == "stale":
        return "stale", "info" if body["state"] == "live" else "warning", body["text"]
    if kind == "model" and body["active"]:
        return "model", "info", f"model version {body['version']} ({body['source']}) is active"
    if kind == "job" and body["job"]["state"] == "failed":
        return "job_failed", "failure", f"{body['job']['kind']} failed: {body['job']['message']}"
    return None


def due(connection: Connection, most: int) -> list[tuple[Delivery, Webhook]]:
    """Return deliveries whose time has come, the oldest first."""
    rows = connection.execute(
        _DELIVERIES + "WHERE state = 'waiting' AND next_us <= ? ORDER BY next_us LIMIT ?", (now_us(), most)
    )
    found = [Delivery(*row) for row in rows]
    return [(delivery, get(connection, delivery.webhook)) for delivery in found]


def settle(connection: Connection, number: int, state: State, reason: str, next_us: int | None) -> None:
    """Note what came of an attempt."""
    connection.execute(
        "UPDATE delivery SET attempts = attempts + 1, state = ?, reason = ?, next_us = ? WHERE id = ?",
        (state, reason, next_us, number),
    )
    connection.execute(
        """DELETE FROM delivery WHERE state != 'waiting' AND id <=
           (SELECT id FROM delivery WHERE state != 'waiting' ORDER BY id DESC LIMIT 1 OFFSET ?)""",
        (KEPT,),
    )


def deliveries(connection: Connection, state: State | None, most: int) -> Sequence[Delivery]:
    """Return deliveries, the newest first."""
    where, values = ("", ()) if state is None else ("WHERE state = ? ", (state,))
    query = _DELIVERIES + where + "ORDER BY id DESC LIMIT ?"
    return [Delivery(*row) for row in connection.execute(query, (*values, most))]


def retry(connection: Connection, number: int) -> Delivery:
    """Let a delivery be tried once more; Missing if there is none of that number."""
    made = connection.execute(
        "UPDATE delivery SET state = 'waiting', next_us = ?, attempts = 0 WHERE id = ?", (now_us(), number)
    )
    if made.rowcount == 0:
        raise Missing(f"there is no delivery {number}")
    return Delivery(*connection.execute(_DELIVERIES + "WHERE id = ?", (number,)).fetchone())
