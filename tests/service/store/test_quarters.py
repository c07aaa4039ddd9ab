"""Segments divided by quarters: cut where one ends, made room for as they come, dropped as a whole, read where they can be."""

import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import pytest

from service.store import appending, quarters, retention, samples, twins
from service.store.batch import Batch
from service.store.connection import Connection
from service.store.database import Database
from service.store.errors import Unavailable
from service.store.postgres import migrations, partitions
from service.store.postgres.engine import Speaking
from service.store.retention import Retention
from service.store.segments import WITHIN, within
from tests.service.postgres import STORES, place_of

SPEC: dict[str, Any] = {"channels": {"a": {}, "b": {}}}
DAY_US = 86_400_000_000


def at(year: int, month: int = 1, day: int = 1) -> int:
    return int(datetime(year, month, day, tzinfo=UTC).timestamp()) * 10**6


def daily(first_us: int, days: int) -> Batch:
    """A sample a day, whose values tell the day."""
    time_us = first_us + DAY_US * np.arange(days, dtype=np.int64)
    return Batch(time_us, np.stack([time_us / DAY_US, -time_us / DAY_US]), time_us + 1)


def parts(url: str) -> dict[str, tuple[int, int]]:
    with psycopg.connect(url) as server:
        return partitions.ranges(Speaking(server))


@pytest.fixture(params=STORES)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    database = Database(place_of(request, tmp_path))
    for name in ("s", "t"):
        database.submit(twins.register, name, SPEC).result(30)
    yield database
    database.close()


def put(database: Database, twin: int, batch: Batch) -> appending.Receipt:
    answer: list[Any] = []
    done = threading.Event()

    def settle(result: Any, error: BaseException | None) -> None:
        answer.append(error or result)
        done.set()

    database.submit_to(twin, settle, appending.append, twin, batch)
    assert done.wait(30)
    if isinstance(answer[0], BaseException):
        raise answer[0]
    receipt: appending.Receipt = answer[0]
    return receipt


def test_quarters_are_those_of_the_calendar() -> None:
    for year, month in ((1990, 1), (2026, 11), (2099, 12)):
        quarter = quarters.quarter_of(at(year, month, 17))
        assert quarters.start_us(quarter) == at(year, 3 * ((month - 1) // 3) + 1)
        assert quarters.name_of(quarter) == f"{year}q{(month + 2) // 3}"
    assert quarters.quarter_of(at(1990) - 1) == 0 and quarters.quarter_of(at(2100)) == len(quarters.STARTS_US)
    assert quarters.quarter_of(at(2099, 12, 31)) == len(quarters.STARTS_US) - 1


def test_no_segment_holds_two_quarters_and_all_are_found(database: Database) -> None:
    """Batches of days, in any order, from before all quarters to behind them; the oracle is a set of instants."""
    generator = np.random.default_rng(0)
    origins = [at(1989, 12, 1), at(2020, 2, 20), at(2020, 6, 1), at(2099, 12, 20), 0]
    expected: set[int] = set()
    for k in range(60):
        days = int(generator.integers(1, 120)) if k % 10 else 600
        batch = daily(origins[k % 5] + DAY_US * int(generator.integers(0, 400)), days)
        assert put(database, 1, batch).first_seq == len(expected) + 1
        expected |= set(batch.time_us.tolist())
    held = np.array(sorted(expected))
    spans = database.engine.read(lambda c: c.execute("SELECT first_us, last_us FROM chunk").fetchall())
    assert all(quarters.quarter_of(first) == quarters.quarter_of(last) for first, last in spans)
    for start, stop in (
        (None, None),
        (at(2020, 4), at(2020, 7)),
        (at(2020, 3, 31), at(2020, 4, 2)),
        (at(2099), None),
        (None, 5),
    ):
        found = database.engine.read(lambda c, a=start, b=stop: samples.select(c, 1, 2, [0], a, b))  # type: ignore[misc]
        inside = held[(held >= (start if start is not None else -1)) & (held < (stop if stop is not None else 2**62))]
        np.testing.assert_array_equal(found.time_us, inside)
        np.testing.assert_array_equal(found.values[0], inside / DAY_US)
    numbers, _ = database.engine.read(lambda c: samples.since_seq(c, 1, 2, 0))
    assert numbers.tolist() == list(range(1, held.size + 1))


def test_a_quarter_is_read_from_its_partition_alone(postgres: str) -> None:
    database = Database(postgres)
    database.submit(twins.register, "s", SPEC).result(30)
    put(database, 1, daily(at(2020), 1500))
    database.close()
    assert len(parts(postgres)) == 2 + 17
    with psycopg.connect(postgres) as server:
        server.execute("SET plan_cache_mode = force_generic_plan")
        query = f"EXPLAIN (ANALYZE, TIMING OFF, COSTS OFF) SELECT time FROM chunk WHERE {WITHIN}".replace("?", "%s")
        plan = "\n".join(row[0] for row in server.execute(query, within(1, at(2021, 5), at(2021, 6)), prepare=True))  # type: ignore[arg-type]
        assert "chunk_2021q2" in plan
        assert all(f"chunk_{other}" not in line for other in ("2021q1", "2021q3", "before") for line in plan.split("\n")
                   if "never executed" not in line)  # fmt: skip


def test_processes_that_make_the_same_partition_at_once(postgres: str) -> None:
    fleet = [Database(postgres) for _ in range(3)]
    for k in range(3):
        fleet[0].submit(twins.register, f"s{k}", SPEC).result(30)
    barrier = threading.Barrier(3)

    def fill(k: int) -> None:
        for year in range(2001, 2005):
            barrier.wait(30)
            for quarter in range(4):
                put(fleet[k], k + 1, daily(at(year, 1 + 3 * quarter), 5))

    threads = [threading.Thread(target=fill, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    heads = fleet[0].engine.read(lambda c: c.execute("SELECT samples FROM head").fetchall())
    for database in fleet:
        database.close()
    assert heads == [(80,)] * 3 and len(parts(postgres)) == 2 + 16


def test_an_undivided_database_goes_on_where_it_stood(postgres: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Long segments of an earlier release are found from every quarter that they reach into; a clock ahead hinders nothing."""
    with monkeypatch.context() as earlier:
        earlier.setattr(migrations, "STEPS", migrations.STEPS[:-1])
        Database(postgres).close()
    old, odd = daily(at(2019, 11), 300), daily(at(2098, 12), 60)
    with psycopg.connect(postgres, autocommit=True) as server:
        server.execute("INSERT INTO twin (name, specification, created_us) VALUES ('s', '{}', 0), ('t', '{}', 0)")
        names = "twin, n, first_us, last_us, last_seq, seq, time, value"
        for batch, last in ((old, 300), (odd, 360)):
            n, ends = batch.time_us.size, (int(batch.time_us[0]), int(batch.time_us[-1]))
            arrays = (np.arange(last - n + 1, last + 1).tobytes(), batch.time_us.tobytes(), batch.values.tobytes())
            server.execute(
                f"INSERT INTO chunk ({names}) VALUES (1, %s, %s, %s, %s, %s, %s, %s)", (n, *ends, last, *arrays)
            )
        first, last = int(old.time_us[0]), int(odd.time_us[-1])
        server.execute(
            "INSERT INTO head (twin, seq, samples, first_us, last_us) VALUES (1, 360, 360, %s, %s)", (first, last)
        )
        server.execute("INSERT INTO head (twin) VALUES (2)")
    database = Database(postgres)
    put(database, 2, daily(at(2097, 3, 30), 4))
    found = database.engine.read(lambda c: samples.select(c, 1, 2, [0], at(2020, 8), at(2020, 8, 3)))
    whole = database.engine.read(lambda c: samples.select(c, 1, 2, [0]))
    identifiers = database.engine.read(lambda c: c.execute("SELECT id FROM chunk ORDER BY id").fetchall())
    database.close()
    assert found.time_us.tolist() == [at(2020, 8), at(2020, 8, 2)]
    np.testing.assert_array_equal(whole.time_us, np.concatenate([old.time_us, odd.time_us]))
    assert identifiers == [(1,), (2,), (3,), (4,)]
    now = datetime.now(UTC)
    made = parts(postgres)
    assert set(made) == {"chunk_before", "chunk_after", "chunk_2097q1", "chunk_2097q2", "chunk_2098q4"}
    assert made["chunk_before"][1] == quarters.start_us(quarters.quarter_of(int(now.timestamp()) * 10**6) + 1)


def test_a_quarter_that_nobody_keeps_is_dropped(postgres: str) -> None:
    database, other = Database(postgres), Database(postgres)
    for name in ("s", "t", "u"):
        database.submit(twins.register, name, SPEC).result(30)
    for twin in (1, 2):
        put(other, twin, daily(at(2020), 366))
        put(database, twin, daily(at(2020) + 366 * DAY_US, 200))
    fine = at(2020) + 60_000_000 * np.arange(1, 2001, dtype=np.int64)  # large enough for an outline
    put(database, 1, Batch(fine, np.zeros((2, fine.size)), fine))
    database.submit(retention.put, 1, Retention(samples_days=200.0)).result(30)
    assert database.engine.drop_old() == 0  # the second twin keeps everything
    database.submit(retention.put, 2, Retention(samples_days=300.0)).result(30)

    def look(connection: Connection) -> list[Any]:
        counts = connection.execute("SELECT count(*) FROM chunk_outline").fetchall()
        return counts + connection.execute("SELECT samples, first_us FROM head WHERE twin < 3 ORDER BY twin").fetchall()

    assert database.engine.read(look)[0] == (1,)
    with psycopg.connect(postgres) as backup:  # whoever reads is not thrown out
        backup.execute("SELECT count(*) FROM chunk")
        with pytest.raises(Unavailable):
            database.engine.drop_old()
    assert "chunk_2020q1" in parts(postgres)
    dropped = [database.engine.drop_old(), database.engine.drop_old(), database.engine.drop_old()]
    assert all(dropped[:2]) and dropped[2] == 0
    assert sorted(parts(postgres)) == ["chunk_2020q3", "chunk_2020q4", "chunk_2021q1", "chunk_2021q2", "chunk_2021q3",
                                       "chunk_after", "chunk_before"]  # fmt: skip
    assert database.engine.read(look) == [(0,), (566 - 182, at(2020, 7)), (566 - 182, at(2020, 7))]
    put(other, 3, daily(at(2020, 2), 3))  # it still believes that the quarter is there
    assert "chunk_2020q1" in parts(postgres)
    held = database.engine.read(lambda c: samples.select(c, 3, 2, [0]))
    assert held.time_us.tolist() == daily(at(2020, 2), 3).time_us.tolist()
    database.submit(twins.delete, "u").result(30)
    assert database.engine.drop_old() == 1 and "chunk_2020q1" not in parts(postgres)  # a deleted twin keeps nothing
    database.close()
    other.close()
