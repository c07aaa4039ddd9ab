"""Leases, epochs and fencing, by the clock of the database."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from service.store import ownership, twins
from service.store.connection import Connection
from service.store.database import Database
from service.store.errors import LeaseLost, TwinGone
from service.store.ownership import SLOTS, Holding, slot_of

LEASE_US = 60_000_000
SPEC: dict[str, Any] = {"twin": "t", "channels": {"a": {}}}


class Rooms:
    """A database and a short way to write to it."""

    def __init__(self, database: Database) -> None:
        """Register one twin."""
        self.database = database
        self.twin = self.do(twins.register, "t", SPEC)[0].key

    def do(self, operation: Callable[..., Any], *args: Any) -> Any:
        """Write, and wait for the commit."""
        return self.database.submit(operation, *args).result(30)

    def lapse(self, name: str) -> None:
        """Let time pass for one member: its leases and its word are long ago."""

        def age(connection: Connection) -> None:
            connection.execute("UPDATE slot SET until_us = clock_us() - 1 WHERE owner = ?", (name,))
            connection.execute("UPDATE member SET beat_us = beat_us - ? WHERE name = ?", (2 * LEASE_US, name))

        self.do(age)

    def renew(self, name: str) -> Holding:
        """Renew the leases of a member."""
        holding: Holding = self.do(ownership.renew, name, LEASE_US)
        return holding


@pytest.fixture
def rooms(postgres: str) -> Iterator[Rooms]:
    database = Database(postgres)
    yield Rooms(database)
    database.close()


def test_slots_are_shared_evenly_and_owned_once(rooms: Rooms) -> None:
    assert len(rooms.renew("one").epochs) == SLOTS
    assert rooms.renew("two").epochs == {}  # nothing is free before the first one gives back its surplus
    for name in ("one", "two", "three", "one", "two", "three"):
        rooms.renew(name)
    held = {name: rooms.renew(name) for name in ("one", "two", "three")}
    assert sorted(len(one.epochs) for one in held.values()) == [84, 86, 86]
    assert sorted(slot for one in held.values() for slot in one.epochs) == list(range(SLOTS))
    assert {one.members for one in held.values()} == {3}


def test_whoever_lapsed_cannot_write_and_epochs_only_grow(rooms: Rooms) -> None:
    slot = slot_of(rooms.twin)
    epoch = rooms.renew("one").epochs[slot]
    rooms.do(ownership.check, rooms.twin, epoch)
    rooms.lapse("one")
    with pytest.raises(LeaseLost):  # although nobody has taken over yet
        rooms.do(ownership.check, rooms.twin, epoch)
    later = rooms.renew("two").epochs[slot]
    assert later > epoch
    rooms.do(ownership.check, rooms.twin, later)
    with pytest.raises(LeaseLost):
        rooms.do(ownership.check, rooms.twin, epoch)
    assert rooms.renew("one").epochs == {}  # a name that comes back owns nothing of before
    with pytest.raises(TwinGone):
        rooms.do(ownership.check, 10**9, later)
    tenures = rooms.do(
        lambda c: c.execute("SELECT epoch, owner FROM tenure WHERE slot = ? ORDER BY 1", (slot,)).fetchall()
    )
    assert tenures == [(epoch, "one"), (later, "two")]


def test_a_takeover_waits_for_a_write_under_way(rooms: Rooms) -> None:
    epoch = rooms.renew("one").epochs[slot_of(rooms.twin)]
    other = Database(rooms.database.engine.url)  # type: ignore[attr-defined]
    order: list[str] = []

    def slowly(connection: Connection) -> None:
        ownership.check(connection, rooms.twin, epoch)
        time.sleep(0.5)
        order.append("written")

    rooms.lapse("one")
    rooms.do(lambda c: c.execute("UPDATE slot SET until_us = clock_us() + 200000 WHERE owner = 'one'") and None)
    rooms.database.submit_to(rooms.twin, lambda result, error: order.append(f"answered {error}"), slowly)
    time.sleep(0.3)  # the lease lapses while the write goes on
    taken = other.submit(ownership.renew, "two", LEASE_US).result(30)
    order.append("taken over")
    assert slot_of(rooms.twin) in taken.epochs
    assert order[0] == "written" and order.index("written") < order.index("taken over")
    other.close()


def test_leaving_gives_everything_back_at_once(rooms: Rooms) -> None:
    rooms.renew("one")
    rooms.do(ownership.give_back, "one")
    assert len(rooms.renew("two").epochs) == SLOTS
