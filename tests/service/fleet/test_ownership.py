"""Leases, epochs and fencing, by the clock of the database."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import psycopg
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

    def renew(self, name: str) -> Holding:
        """Renew the leases of a member."""
        holding: Holding = self.do(ownership.renew, name, LEASE_US)
        return holding


def lapse(connection: Connection, name: str) -> None:
    """Let time pass for one member: its leases and its word are long ago."""
    connection.execute("UPDATE slot SET until_us = clock_us() - 1 WHERE owner = ?", (name,))
    connection.execute("UPDATE member SET beat_us = beat_us - ? WHERE name = ?", (2 * LEASE_US, name))


@pytest.fixture
def rooms(postgres: str) -> Iterator[Rooms]:
    database = Database(postgres)
    yield Rooms(database)
    database.close()


@pytest.mark.parametrize("processes", [2, 4, 8])
@pytest.mark.parametrize("first", [1, 250])
def test_twins_that_were_registered_one_after_the_other_go_to_all_processes(processes: int, first: int) -> None:
    """However slots are shared out in runs, nobody has more than two of a few dozen twins more than another."""
    share = SLOTS // processes
    counts = [0] * processes
    for twin in range(first, first + 50):
        counts[slot_of(twin) // share] += 1
    assert max(counts) - min(counts) <= 2


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
    rooms.do(lapse, "one")
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


def test_a_takeover_waits_for_a_write_under_way(rooms: Rooms, postgres: str) -> None:
    epoch = rooms.renew("one").epochs[slot_of(rooms.twin)]
    other = Database(postgres)
    order: list[str] = []
    is_under_way, may_end, all_told = threading.Event(), threading.Event(), threading.Barrier(3)

    def slowly(connection: Connection) -> None:
        ownership.check(connection, rooms.twin, epoch)
        is_under_way.set()
        assert may_end.wait(30)
        order.append("written")

    def tell(what: str) -> None:
        order.append(what)
        all_told.wait(30)

    rooms.database.submit_to(rooms.twin, lambda result, error: tell(f"answered {error}"), slowly)
    assert is_under_way.wait(30)
    other.submit(lapse, "one").result(30)
    takeover = other.submit(ownership.renew, "two", LEASE_US)
    takeover.add_done_callback(lambda done: tell("taken over"))
    with psycopg.connect(postgres, autocommit=True) as server:
        waits = "SELECT 1 FROM pg_stat_activity WHERE wait_event_type = 'Lock' AND query LIKE 'UPDATE head SET epoch%'"
        while server.execute(waits).fetchone() is None:
            assert not takeover.done()
            time.sleep(0.05)
    may_end.set()
    assert slot_of(rooms.twin) in takeover.result(30).epochs
    all_told.wait(30)  # both are told by threads of their own
    other.close()
    assert order[0] == "written" and sorted(order[1:]) == ["answered None", "taken over"]


def test_a_process_that_vanishes_inside_of_a_transaction_holds_nobody_up(rooms: Rooms, postgres: str) -> None:
    """Nobody tells the database that a cable was cut: it ends the transaction by itself, before others give up waiting."""
    is_under_way, may_end = threading.Event(), threading.Event()

    def vanishes(connection: Connection) -> None:
        is_under_way.set()
        may_end.wait(60)

    ended: list[BaseException | None] = []
    rooms.database.submit_to(rooms.twin, lambda result, error: ended.append(error), vanishes)
    assert is_under_way.wait(30)
    other = Database(postgres)
    written = threading.Event()
    refused: list[BaseException | None] = []

    def answered(result: object, error: BaseException | None) -> None:
        refused.append(error)
        written.set()

    other.submit_to(rooms.twin, answered, lambda connection: None)
    assert written.wait(60) and refused == [None]
    may_end.set()
    other.close()
    rooms.do(lambda connection: None)
    assert ended == [None]  # it was done again on a new connection


def test_leaving_gives_everything_back_at_once(rooms: Rooms) -> None:
    rooms.renew("one")
    rooms.do(ownership.give_back, "one")
    assert len(rooms.renew("two").epochs) == SLOTS
