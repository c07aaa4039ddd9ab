"""Changes of the archive that are not ingest: deletions, undone ones, samples that leave quarantine. The stream hears of them."""

from collections.abc import Sequence

from service.archive.intake import take_in
from service.instants import now_us
from service.store import aside, events
from service.store.appending import Receipt
from service.store.aside import Deletion
from service.store.connection import Connection
from service.stream.messages import EventStretch, Stretch
from service.twins.registry import Entry


def delete(
    connection: Connection, twin: Entry, start_us: int | None, stop_us: int | None, channels: list[str] | None
) -> tuple[Deletion, Sequence[Stretch]]:
    """Take a part of the archive out for a day."""
    made = aside.delete(connection, twin.key, twin.channels, start_us, stop_us, channels)
    return made, _news(connection, twin, {"deleted": made.wire()})


def undo(connection: Connection, twin: Entry, number: int) -> tuple[Deletion, Sequence[Stretch]]:
    """Put back what a deletion took; what came meanwhile stays as it is."""
    made, back = aside.undo(connection, twin.key, len(twin.channels), number)
    _, stretches = take_in(connection, twin, back, 0)
    return made, [*stretches, *_news(connection, twin, {"restored": made.wire()})]


def release(
    connection: Connection, twin: Entry, start_us: int | None, stop_us: int | None
) -> tuple[Receipt, Sequence[Stretch]]:
    """Let samples out of quarantine into the archive."""
    found = aside.release(connection, twin.key, len(twin.channels), start_us, stop_us)
    receipt, stretches = take_in(connection, twin, found, 0)
    return receipt, [*stretches, *_news(connection, twin, {"released": int(found.time_us.size)})]


def _news(connection: Connection, twin: Entry, body: dict[str, object]) -> list[Stretch]:
    return [EventStretch(tuple(events.append(connection, twin.key, now_us(), [("telemetry", body)])))]
