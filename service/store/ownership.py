"""Slots and their owners. Every twin belongs to a slot; who owns the slot follows the twin's samples.

An owner holds a lease, which it renews, by the clock of the database alone. Whoever takes over a slot gets a greater epoch and
writes it into the heads of its twins; that waits for a write that is under way and ends all later ones of the former owner.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from service.store.connection import Connection
from service.store.errors import LeaseLost, TwinGone

SLOTS = 256
SPREAD = 159
"""Odd, and near to SLOTS divided by the golden ratio: twins that are numbered one after the other spread evenly over any run of
slots (multiplicative hashing, D. E. Knuth, The Art of Computer Programming 3, section 6.4)."""


LEASE_S = 5.0
"""So long after its last word a process is taken for dead."""
ATTENDING = 28_871
"""First key of the advisory lock that every process at work on a database shares; the second one stands for the schema."""


def slot_of(twin: int) -> int:
    """Return the slot of a twin."""
    return twin * SPREAD % SLOTS


@dataclass(frozen=True)
class Holding:
    """What a process owns: slot -> epoch. Others share the rest with it. ``clock_us`` is the database's, when it was asked."""

    epochs: dict[int, int]
    members: int
    clock_us: int | None = None


def renew(connection: Connection, name: str, lease_us: int) -> Holding:
    """Say that a process lives, renew its leases, and take or give back slots so that all processes have as many.

    Parameters
    ----------
    name
        Of the process, unique among all that ever ran.
    lease_us
        From now on; a process that has not been heard of for so long is taken for dead.
    """
    connection.execute(
        """INSERT INTO member (name, beat_us) VALUES (?, clock_us())
           ON CONFLICT (name) DO UPDATE SET beat_us = excluded.beat_us""",
        (name,),
    )
    connection.execute("DELETE FROM member WHERE beat_us < clock_us() - ?", (lease_us,))
    members, clock_us = connection.execute("SELECT count(*), clock_us() FROM member").fetchone()
    query = (
        "UPDATE slot SET until_us = clock_us() + ? WHERE owner = ? AND until_us > clock_us() RETURNING number, epoch"
    )
    epochs = dict(connection.execute(query, (lease_us, name)).fetchall())
    share = -(-SLOTS // max(members, 1))
    surplus = sorted(epochs)[share:]
    if surplus:
        connection.execute(
            "UPDATE slot SET owner = NULL, until_us = 0 WHERE owner = ? AND number = ANY(?)", (name, surplus)
        )
        epochs = {slot: epoch for slot, epoch in epochs.items() if slot not in surplus}
    elif len(epochs) < share:
        epochs |= _take(connection, name, share - len(epochs), lease_us)
    return Holding(epochs, members, clock_us)


def attend(connection: Connection) -> None:
    """Let others see, for as long as the connection lives, that a process is at work on the database."""
    connection.execute("SELECT pg_advisory_lock_shared(?, hashtext(current_schema()))", (ATTENDING,))


def is_attended(connection: Connection) -> bool:
    """Return whether a service or a worker is at work on the database; if none is, none begins before the transaction ends."""
    query = "SELECT count(*) FROM member WHERE beat_us > clock_us() - ?"
    members = connection.execute(query, (round(1e6 * LEASE_S),)).fetchone()[0]
    query = "SELECT pg_try_advisory_xact_lock(?, hashtext(current_schema()))"
    return members > 0 or not connection.execute(query, (ATTENDING,)).fetchone()[0]


def _take(connection: Connection, name: str, most: int, lease_us: int) -> dict[int, int]:
    """Take slots that nobody owns, and fence off who did."""
    taken = dict(
        connection.execute(
            """UPDATE slot SET owner = ?, epoch = epoch + 1, until_us = clock_us() + ? WHERE number IN
               (SELECT number FROM slot WHERE until_us <= clock_us() ORDER BY number LIMIT ? FOR UPDATE SKIP LOCKED)
               RETURNING number, epoch""",
            (name, lease_us, most),
        ).fetchall()
    )
    if taken:
        rows = [(slot, epoch, name) for slot, epoch in taken.items()]
        connection.executemany("INSERT INTO tenure (slot, epoch, owner, from_us) VALUES (?, ?, ?, clock_us())", rows)
        connection.execute(
            """UPDATE head SET epoch = slot.epoch FROM slot WHERE slot.number = mod(head.twin * ?, ?) AND head.twin IN
               (SELECT twin FROM head WHERE mod(twin * ?, ?) = ANY(?) ORDER BY twin FOR UPDATE)""",
            (SPREAD, SLOTS, SPREAD, SLOTS, sorted(taken)),
        )
    return taken


def give_back(connection: Connection, name: str) -> None:
    """Leave: others need not wait for the leases to lapse."""
    connection.execute("UPDATE slot SET owner = NULL, until_us = 0 WHERE owner = ?", (name,))
    connection.execute("DELETE FROM member WHERE name = ?", (name,))


def check(connection: Connection, twin: int, epoch: int) -> None:
    """Refuse to write for somebody who does not own a twin any more; the head of the twin is locked.

    Raises
    ------
    LeaseLost, TwinGone
        If the lease lapsed or another process took over; if the twin was deleted.
    """
    row = connection.execute(
        """SELECT head.epoch, slot.epoch, slot.until_us > clock_us() FROM head, slot
           WHERE head.twin = ? AND slot.number = ?""",
        (twin, slot_of(twin)),
    ).fetchone()
    if row is None:
        raise TwinGone(f"twin {twin} is gone")
    if row[0] > epoch or row[1] != epoch or not row[2]:
        raise LeaseLost(f"twin {twin} is followed by another process now")


@dataclass(frozen=True)
class Changed:
    """How one twin stands, as far as other processes need to know."""

    twin: int
    name: str
    revision: int
    seq: int
    archive: int
    activation: int


def changes(connection: Connection, twins: Sequence[int] | None = None) -> list[Changed]:
    """Return how every twin stands, or some of them."""
    where = "" if twins is None else "WHERE twin.id = ANY(?)"
    query = f"""SELECT twin.id, twin.name, twin.revision, head.seq, head.revision,
                (SELECT coalesce(max(activation.id), 0) FROM activation WHERE activation.twin = twin.id)
                FROM twin JOIN head ON head.twin = twin.id {where} ORDER BY twin.id"""
    return [Changed(*row) for row in connection.execute(query, () if twins is None else (list(twins),))]
