"""What shares a commit on PostgreSQL goes through a stage; the archive is the one that a SQLite file has, batch by batch."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.instants import now_us
from service.store import appending, events, samples, segments, twins
from service.store.batch import Batch
from service.store.connection import Connection
from service.store.database import Database, _settle
from service.store.postgres.stage import FEW, Stage

TWINS, ROUNDS, ORDERS = 5, 60, 14
SPEC = {"channels": {"a": {}, "b": {}}}
HEAD = "SELECT seq, samples, first_us, last_us FROM head WHERE twin = ?"
SMALL = """SELECT small_chunks, small_rows, (SELECT count(*) FROM chunk WHERE twin = head.twin AND n < 512),
           (SELECT sum(n) FROM chunk WHERE twin = head.twin AND n < 512) FROM head WHERE twin = ?"""
"""A server compacts with the commit, a file at once: each must have counted what it has."""
Operation = tuple[int, Callable[..., Any], tuple[Any, ...]]


@pytest.fixture
def stores(tmp_path: Path, postgres: str) -> Iterator[tuple[Database, Database]]:
    """A file and a server with the same twins."""
    both = Database(tmp_path / "t.sqlite3"), Database(postgres)
    for database in both:
        for k in range(TWINS):
            database.submit(twins.register, f"t{k}", SPEC).result(30)
    yield both
    for database in both:
        database.close()


def together(database: Database, orders: Sequence[Operation]) -> list[Any]:
    """Run operations in one commit; return what each of them returns, or raises."""
    begin = threading.Event()
    database.submit(lambda connection: begin.wait(30))
    answers: list[Future[Any]] = [Future() for _ in orders]
    for (twin, operation, arguments), answer in zip(orders, answers, strict=True):
        database.submit_to(twin, partial(_settle, answer), operation, twin, *arguments)
    begin.set()
    return [answer.exception(30) or answer.result(30) for answer in answers]


def appended(connection: Connection, twin: int, batch: Batch) -> tuple[list[int], int, int | None]:
    receipt = appending.append(connection, twin, batch)
    return receipt.status.tolist(), receipt.first_seq, receipt.last_us


def told(connection: Connection, twin: int) -> int:
    """Let a message take a number of the stream, as assimilation does."""
    return events.append(connection, twin, now_us(), [("model", {})])[0].seq


def broken(connection: Connection, twin: int) -> None:
    connection.execute("UPDATE head SET seq = seq + 1000 WHERE twin = ?", (twin,))
    raise ValueError("undone alone")


def a_round(generator: np.random.Generator, newest: list[int]) -> list[Operation]:
    """Return operations as they come: most go on from the newest sample, some are late, sent twice, or something else."""
    orders: list[Operation] = []
    for _ in range(int(generator.integers(1, ORDERS))):
        twin, kind = int(generator.integers(TWINS)), generator.random()
        if kind < 0.1:
            orders.append((twin + 1, told, ()))
            continue
        if kind < 0.12:
            orders.append((twin + 1, broken, ()))
            continue
        n = int(generator.integers(1, 12)) if kind < 0.95 else 300
        first = newest[twin] + 1 if kind > 0.3 else max(newest[twin] - 8, 0)
        time_us = (first + np.arange(n, dtype=np.int64)) * 1000
        newest[twin] = max(newest[twin], first + n - 1)
        batch = Batch(time_us, np.stack([time_us * 1.0, -time_us * 1.0]), time_us + 1)
        orders += [(twin + 1, appended, (batch,))] * (2 if kind > 0.9 else 1)
    return orders


def test_a_server_stores_what_a_file_stores(stores: tuple[Database, Database], monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    flush = Stage.flush

    def counted(stage: Stage, *after: str) -> None:
        sizes.append(len(stage._rows))
        flush(stage, *after)

    monkeypatch.setattr(Stage, "flush", counted)
    monkeypatch.setattr(appending, "MOST_STAGED_CHUNKS", segments.MOST_SMALL_CHUNKS // 2)
    generator, newest = np.random.default_rng(0), [-1] * TWINS
    for _ in range(ROUNDS):
        orders = a_round(generator, newest)
        ours, theirs = (together(database, orders) for database in stores)
        assert [str(one) for one in ours] == [str(one) for one in theirs]
    assert max(sizes) > FEW and any(0 < size <= FEW for size in sizes)
    for twin in range(1, TWINS + 1):
        heads, held, replayed = (
            [database.engine.read(partial(read, twin)) for database in stores]
            for read in (
                lambda key, c: c.execute(HEAD, (key,)).fetchone(),
                lambda key, c: samples.select(c, key, 2, [0, 1]),
                lambda key, c: samples.since_seq(c, key, 2, 50)[0],
            )
        )
        assert tuple(heads[0]) == tuple(heads[1])
        for database in stores:
            chunks, rows, *really = database.engine.read(lambda c, key=twin: c.execute(SMALL, (key,)).fetchone())
            assert [chunks, rows] == really and chunks < segments.MOST_SMALL_CHUNKS
        np.testing.assert_array_equal(held[0].time_us, np.arange(newest[twin - 1] + 1) * 1000)
        np.testing.assert_array_equal(held[0].time_us, held[1].time_us)
        np.testing.assert_array_equal(held[0].values, held[1].values)
        np.testing.assert_array_equal(replayed[0], replayed[1])


def test_what_a_head_has_passed_does_not_enter_again(postgres: str) -> None:
    """The statement itself refuses what is in the archive, whoever put it into the stage."""
    database = Database(postgres)
    database.submit(twins.register, "t", SPEC).result(30)
    time_us = np.arange(3, dtype=np.int64)
    batch = Batch(time_us, np.zeros((2, 3)), time_us)

    def twice(connection: Any, twin: int) -> None:
        for _ in range(2):
            connection.stage.put(segments.segment(twin, time_us + 1, batch))
            connection.stage.flush()

    together(database, [(1, twice, ())])
    counts = database.engine.read(lambda c: c.execute("SELECT count(*), max(samples) FROM chunk, head").fetchone())
    database.close()
    assert tuple(counts) == (1, 3)
