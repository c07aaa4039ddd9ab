"""One writer for all: shared commits, isolated failures, readers beside it, migrations."""

import asyncio
import resource
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from service.store.connection import Connection
from service.store.database import Database
from service.store.errors import DiskFull, StoreError
from service.store.sqlite import migrations
from tests.service.postgres import STORES, place_of


@pytest.fixture(params=STORES)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    opened = Database(place_of(request, tmp_path))
    opened.submit(lambda c: c.execute("CREATE TABLE t (x INTEGER PRIMARY KEY)") and None).result()
    yield opened
    opened.close()


def put(connection: sqlite3.Connection, *numbers: int) -> int:
    for number in numbers:
        connection.execute("INSERT INTO t VALUES (?)", (number,))
    return len(numbers)


def numbers(connection: Connection) -> list[int]:
    return [x for (x,) in connection.execute("SELECT x FROM t ORDER BY x")]


def test_a_failing_operation_undoes_itself_alone(database: Database) -> None:
    gate = database.submit(lambda c: __import__("time").sleep(0.05))  # let the others queue up behind one commit
    answers = [database.submit(put, 1), database.submit(put, 2, 1), database.submit(put, 3)]
    gate.result()
    assert answers[0].result() == 1 and answers[2].result() == 1
    with pytest.raises((sqlite3.IntegrityError, psycopg.IntegrityError)):
        answers[1].result()
    assert asyncio.run(database.read(numbers)) == [1, 3]


def test_any_exception_undoes_the_operation(database: Database) -> None:
    def half(connection: Connection) -> None:
        put(connection, 7)
        raise LookupError("gone")

    with pytest.raises(LookupError):
        database.submit(half).result()
    assert asyncio.run(database.read(numbers)) == []


def test_readers_cannot_write_and_see_what_is_committed(database: Database) -> None:
    async def use() -> list[int]:
        await database.write(put, 5)
        with pytest.raises((sqlite3.OperationalError, psycopg.InternalError), match=r"read-?only"):
            await database.read(put, 6)
        return await database.read(numbers)

    assert asyncio.run(use()) == [5]


def test_one_process_at_a_time(tmp_path: Path) -> None:
    database = Database(tmp_path / "t.sqlite3")
    with pytest.raises(StoreError, match="another server uses this database"):
        Database(tmp_path / "t.sqlite3")
    database.close()


def test_durability_settings(tmp_path: Path) -> None:
    database = Database(tmp_path / "t.sqlite3")
    assert database.submit(lambda c: c.execute("PRAGMA synchronous").fetchone()[0]).result() == 2
    assert database.submit(lambda c: c.execute("PRAGMA journal_mode").fetchone()[0]).result() == "wal"
    database.close()


def test_migrations_run_once_and_newer_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.sqlite3"
    Database(path).close()
    with sqlite3.connect(path, isolation_level=None) as connection:
        assert migrations.migrate(connection) == []
        connection.execute("INSERT INTO migration (name) VALUES ('from the future')")
    connection.close()
    with pytest.raises(StoreError, match="newer version"):
        Database(path)


def test_a_failed_step_leaves_no_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = "CREATE TABLE half (x); CREATE TABLE nonsense ("
    path = tmp_path / "t.sqlite3"
    Database(path).close()
    monkeypatch.setattr(migrations, "STEPS", (*migrations.STEPS, ("broken", broken)))
    with pytest.raises(StoreError):
        Database(path)
    monkeypatch.undo()
    Database(path).close()
    with sqlite3.connect(path) as connection:
        assert connection.execute("SELECT count(*) FROM sqlite_master WHERE name = 'half'").fetchone() == (0,)
    connection.close()


def test_a_full_disk_stops_neither_a_reader_nor_a_start(tmp_path: Path) -> None:
    """A connection that is set up writes nothing to a file that exists; a file-size limit stands in for the disk."""
    file = tmp_path / "twin.sqlite3"
    database = Database(file)
    database.submit(lambda c: c.execute("CREATE TABLE t (x)") and None).result()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (Path(f"{file}-wal").stat().st_size + 100, limits[1]))
    try:
        with pytest.raises(DiskFull):
            database.submit(lambda c: c.execute("INSERT INTO t VALUES (zeroblob(100000))") and None).result()
        assert database.engine.read(numbers) == []  # the first read: its connection is made now
        database.close()
        database = Database(file)
        assert database.engine.read(numbers) == []
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        database.close()
