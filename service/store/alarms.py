"""Alarms: stays of a channel beyond a limit, measured or forecast, and what an operator has said to them."""

from dataclasses import dataclass
from typing import Any

import orjson

from service.instants import format_instant, now_us
from service.store.connection import Connection
from service.store.errors import Missing

Json = dict[str, Any]
MEASURED, FORECAST = "measured", "forecast"
"""Where a limit is watched."""
KEPT = 5000
"""Alarms that have ended are kept up to this number per twin, the newest."""


@dataclass(frozen=True)
class Limit:
    """One limit of one channel: ``bound`` in the channel's own unit, on the ``low`` or ``high`` side, and where it is watched."""

    origin: str
    channel: str
    colour: str
    side: str
    bound: float


@dataclass(frozen=True)
class AlarmRow:
    """One alarm; ``stop_us`` is None while it lasts, ``body`` says what is known of it beyond that."""

    id: int
    limit: Limit
    start_us: int
    stop_us: int | None
    body: Json
    acknowledged_us: int | None
    note: str | None
    shelved_until_us: int | None

    def is_shelved(self, at_us: int) -> bool:
        """Return whether an operator does not want to hear of it now."""
        return self.shelved_until_us is not None and self.shelved_until_us > at_us

    @property
    def message(self) -> str:
        """What the alarm says, in the past tense once it is over."""
        said = str(self.body["message"])
        if self.stop_us is None:
            return said
        if self.limit.origin == MEASURED:
            return said.replace(" is ", " was ", 1)
        return said.replace(" reaches ", " was forecast to reach ", 1)

    def wire(self) -> Json:
        """Return the alarm as clients see it."""
        at_us = now_us()
        acknowledged = None
        if self.acknowledged_us is not None:
            acknowledged = {"time": format_instant(self.acknowledged_us), "note": self.note}
        return {
            "id": self.id,
            "on": self.limit.origin,
            "channel": self.limit.channel,
            "colour": self.limit.colour,
            "side": self.limit.side,
            "limit": self.limit.bound,
            "start": format_instant(self.start_us),
            "stop": None if self.stop_us is None else format_instant(self.stop_us),
            **self.body,
            "message": self.message,
            "acknowledged": acknowledged,
            "shelved_until": format_instant(self.shelved_until_us or 0) if self.is_shelved(at_us) else None,
        }


_SELECT = """SELECT id, origin, channel, colour, side, bound, start_us, stop_us, body, acknowledged_us, note,
             shelved_until_us FROM alarm """


def _row(row: tuple[Any, ...]) -> AlarmRow:
    return AlarmRow(row[0], Limit(*row[1:6]), row[6], row[7], orjson.loads(row[8]), *row[9:])


def write(
    connection: Connection, twin: int, limit: Limit, start_us: int, stop_us: int | None, body: Json
) -> AlarmRow | None:
    """Write down that an alarm began, went on or ended; return it if that is news, None if only its body changed.

    An alarm on a limit that is shelved is shelved with it.
    """
    place = (twin, limit.origin, limit.channel, limit.colour, limit.side)
    where = "WHERE twin = ? AND origin = ? AND channel = ? AND colour = ? AND side = ?"
    text = orjson.dumps(body).decode()
    query = f"SELECT id FROM alarm {where} AND bound = ? AND start_us = ?"
    known = connection.execute(query, (*place, limit.bound, start_us)).fetchone()
    if known is not None:
        query = "UPDATE alarm SET stop_us = ?, body = ? WHERE id = ?"
        connection.execute(query, (stop_us, text, known[0]))
        return None if stop_us is None else get(connection, twin, known[0])
    shelved = connection.execute(f"SELECT max(shelved_until_us) FROM alarm {where}", place).fetchone()[0]
    (number,) = connection.execute(
        """INSERT INTO alarm (twin, origin, channel, colour, side, bound, start_us, stop_us, body, shelved_until_us)
           VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?) RETURNING id""",
        (*place, limit.bound, start_us, stop_us, text, shelved if shelved and shelved > now_us() else None),
    ).fetchone()
    connection.execute(
        """DELETE FROM alarm WHERE twin = ? AND stop_us IS NOT NULL AND id <=
           (SELECT id FROM alarm WHERE twin = ? ORDER BY id DESC LIMIT 1 OFFSET ?)""",
        (twin, twin, KEPT),
    )
    return get(connection, twin, number)


def change(connection: Connection, twin: int, number: int, start_us: int, stop_us: int | None, body: Json) -> AlarmRow:
    """Write down what is known of an alarm by now, and return it."""
    query = "UPDATE alarm SET start_us = ?, stop_us = ?, body = ? WHERE id = ?"
    connection.execute(query, (start_us, stop_us, orjson.dumps(body).decode(), number))
    return get(connection, twin, number)


def end(connection: Connection, twin: int, number: int, stop_us: int, why: str | None = None) -> AlarmRow:
    """End an alarm that lasts; ``why``, where it is not that readings came back, is added to what it says."""
    row = get(connection, twin, number)
    body = row.body if why is None else row.body | {"message": f"{row.body['message']}; {why}"}
    return change(connection, twin, number, row.start_us, max(row.start_us, stop_us), body)


def remove(connection: Connection, twin: int, number: int) -> None:
    """Forget an alarm."""
    connection.execute("DELETE FROM alarm WHERE twin = ? AND id = ?", (twin, number))


def get(connection: Connection, twin: int, number: int) -> AlarmRow:
    """Return one alarm; Missing if there is none of that number."""
    row = connection.execute(_SELECT + "WHERE twin = ? AND id = ?", (twin, number)).fetchone()
    if row is None:
        raise Missing(f"there is no alarm {number}")
    return _row(row)


def lasting(connection: Connection, twin: int) -> list[AlarmRow]:
    """Return the alarms that last."""
    query = _SELECT + "WHERE twin = ? AND stop_us IS NULL ORDER BY id"
    return [_row(row) for row in connection.execute(query, (twin,))]


def between(connection: Connection, twin: int, limit: Limit, first_us: int, last_us: int) -> list[AlarmRow]:
    """Return the alarms of a limit that lasted at any time from one instant to another, in their order."""
    query = (
        _SELECT
        + """WHERE twin = ? AND origin = ? AND channel = ? AND colour = ? AND side = ? AND bound = ?
             AND start_us <= ? AND (stop_us IS NULL OR stop_us >= ?) ORDER BY start_us, id"""
    )
    place = (limit.origin, limit.channel, limit.colour, limit.side, limit.bound)
    return [_row(row) for row in connection.execute(query, (twin, *place, last_us, first_us))]


def select(connection: Connection, twin: int, most: int) -> list[AlarmRow]:
    """Return the newest alarms, those first that last and are not shelved, the red ones before the yellow ones."""
    query = (
        _SELECT
        + """WHERE twin = ? ORDER BY stop_us IS NULL AND coalesce(shelved_until_us, 0) <= ? DESC, stop_us IS NULL DESC,
             CASE WHEN stop_us IS NULL THEN colour = 'red' END DESC, start_us DESC, id DESC LIMIT ?"""
    )
    return [_row(row) for row in connection.execute(query, (twin, now_us(), most))]


def acknowledge(connection: Connection, twin: int, number: int, note: str | None) -> AlarmRow:
    """Note that somebody has seen an alarm; the first one counts, the last note stays."""
    get(connection, twin, number)
    query = "UPDATE alarm SET acknowledged_us = coalesce(acknowledged_us, ?), note = coalesce(?, note) WHERE id = ?"
    connection.execute(query, (now_us(), note, number))
    return get(connection, twin, number)


def shelve(connection: Connection, twin: int, number: int, until_us: int | None) -> AlarmRow:
    """Put the limit of an alarm aside until an instant, or take it up again; alarms on the other limits are as ever."""
    limit = get(connection, twin, number).limit
    connection.execute(
        """UPDATE alarm SET shelved_until_us = ? WHERE twin = ? AND origin = ? AND channel = ? AND colour = ? AND side = ?
           AND (stop_us IS NULL OR id = ? OR shelved_until_us IS NOT NULL)""",
        (until_us, twin, limit.origin, limit.channel, limit.colour, limit.side, number),
    )
    return get(connection, twin, number)


def watched(connection: Connection, twin: int) -> tuple[int, Json]:
    """Return the stream number up to which measured limits were watched, and the state there."""
    row = connection.execute("SELECT seq, state FROM watched WHERE twin = ?", (twin,)).fetchone()
    return (-1, {}) if row is None else (row[0], orjson.loads(row[1]))


def watch(connection: Connection, twin: int, seq: int, state: Json) -> None:
    """Note up to where measured limits were watched."""
    query = """INSERT INTO watched (twin, seq, state) VALUES (?, ?, ?)
               ON CONFLICT (twin) DO UPDATE SET seq = excluded.seq, state = excluded.state"""
    connection.execute(query, (twin, seq, orjson.dumps(state).decode()))


def taken(connection: Connection, twin: int, start_us: int, stop_us: int) -> None:
    """Note that samples were taken out of the archive: the next look asks which alarms still stand, and tells nothing again."""
    seq, state = watched(connection, twin)
    if seq >= 0:
        before = state.get("taken", [start_us, stop_us])
        watch(connection, twin, seq, state | {"taken": [min(start_us, before[0]), max(stop_us, before[1])]})
