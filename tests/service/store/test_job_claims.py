"""Jobs are done by one worker at a time, taken over when it falls silent, and written by nobody else; on both stores."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from service.store import jobs, twins
from service.store.database import Database
from service.store.errors import LeaseLost
from service.store.jobs import Claim
from tests.service.postgres import STORES, place_of

LEASE_US = 30_000_000
SPEC: dict[str, Any] = {"twin": "t", "channels": {"a": {}}}


class Queue:
    """A store with one twin, and short ways to use its queue."""

    def __init__(self, database: Database) -> None:
        """Register the twin."""
        self.database = database
        self.twin = self.do(twins.register, "t", SPEC)[0].key

    def do(self, operation: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Write, and wait for the commit."""
        return self.database.submit(operation, *args, **options).result(30)

    def add(self, *names: str) -> None:
        """Queue jobs."""
        for name in names:
            self.do(jobs.create, self.twin, name, "calibration", {"n": name})

    def claim(self, worker: str) -> Claim | None:
        """Take one."""
        found: Claim | None = self.do(jobs.claim, worker, LEASE_US, is_shared=self.database.is_shared)
        return found

    def silence(self, job: str) -> None:
        """Let a worker's last word on a job be long ago."""
        self.do(lambda c: c.execute("UPDATE job SET beat_us = beat_us - ? WHERE id = ?", (2 * LEASE_US, job)) and None)

    def state(self, job: str) -> str:
        """Return how a job stands."""
        row = self.database.engine.read(lambda c: jobs.get(c, self.twin, "calibration", job))
        return row.state


@pytest.fixture(params=STORES)
def queue(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Queue]:
    database = Database(place_of(request, tmp_path))
    yield Queue(database)
    database.close()


def test_the_oldest_goes_first_and_each_to_one_worker(queue: Queue) -> None:
    queue.add("first", "second")
    one, other = queue.claim("a"), queue.claim("b")
    assert one is not None and other is not None
    assert (one.job, one.attempt, one.request) == ("first", 1, {"n": "first"}) and other.job == "second"
    assert queue.claim("c") is None
    assert queue.do(jobs.beat, "a") == {"first": (1, False)}


def test_a_silent_worker_is_replaced_and_can_write_nothing_more(queue: Queue) -> None:
    queue.add("first")
    old = queue.claim("a")
    assert old is not None and queue.claim("b") is None
    queue.silence("first")
    assert queue.claim("a") is None  # it has it already
    new = queue.claim("b")
    assert new is not None and (new.job, new.attempt) == ("first", 2)
    for operation, *rest in ((jobs.report, 0.5, "half"), (jobs.end, "failed", "late"), (jobs.put_back,), (jobs.hold,)):
        with pytest.raises(LeaseLost):
            queue.do(operation, old, *rest)
    assert queue.state("first") == "running"
    queue.do(jobs.end, new, "failed", "of itself")
    assert queue.state("first") == "failed"
    with pytest.raises(LeaseLost):
        queue.do(jobs.report, new, 0.9, "after the end")


def test_who_gave_a_job_back_writes_nothing_of_it_any_more(queue: Queue) -> None:
    """A progress message may still be under way when a job is given back: its token fits no later worker."""
    queue.add("first")
    for gives_back in (
        lambda held: queue.do(jobs.put_back, held),
        lambda held: queue.do(jobs.leave, "a", is_shared=True),
    ):
        held = queue.claim("a")
        assert held is not None
        gives_back(held)
        assert queue.state("first") == "queued"
        again = queue.claim("b")
        assert again is not None and again.attempt > held.attempt and again.tries == 1  # to give back is no attempt
        with pytest.raises(LeaseLost):
            queue.do(jobs.report, held, 0.5, "too late")
        queue.do(jobs.put_back, again)


def test_cancelling(queue: Queue) -> None:
    queue.add("first")
    held = queue.claim("b")
    assert held is not None
    queue.do(jobs.ask_to_cancel, "first")
    assert queue.do(jobs.beat, "b") == {"first": (1, True)}
    queue.add("second")
    queue.do(jobs.finish_waiting, "second")
    assert queue.state("second") == "cancelled" and queue.claim("c") is None


def test_many_workers_at_once_do_each_job_once(tmp_path: Path, postgres: str) -> None:
    places = [Database(postgres) for _ in range(4)]
    queue = Queue(places[0])
    queue.add(*(f"job{k}" for k in range(40)))

    def drain(database: Database, worker: str) -> list[str]:
        done = []
        while (held := database.submit(jobs.claim, worker, LEASE_US, is_shared=True).result(30)) is not None:
            database.submit(jobs.end, held, "succeeded", "").result(30)
            done.append(held.job)
        return done

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(drain, places, "abcd"))
    assert sorted(job for done in found for job in done) == sorted(f"job{k}" for k in range(40))
    for database in places:
        database.close()
