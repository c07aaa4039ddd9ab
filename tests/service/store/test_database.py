"""One writer for all: shared commits, isolated failures, readers beside it, migrations."""

import asyncio
import contextlib
import resource
import sqlite3
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace

import psycopg
import pytest

from service.store.connection import Connection
from service.store.database import Database
from service.store.errors import DiskFull, StoreError
from service.store.sqlite import migrations
from service.store.sqlite.engine import SqliteSession
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


class Clock:
    """A clock on which each durable commit takes as long as a test says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, commit_s: float) -> None:
        """Let the database read it."""
        self.now_s, self.commit_s = 0.0, commit_s
        commit = SqliteSession.commit

        def taking_long(session: SqliteSession) -> None:
            commit(session)
            self.now_s += self.commit_s

        monkeypatch.setattr(SqliteSession, "commit", taking_long)
        monkeypatch.setattr("service.store.database.time", SimpleNamespace(perf_counter=lambda: self.now_s))


def written_by(database: Database, count: int) -> list[str]:
    """Return which thread made each of some small writes, one after the other."""
    found = []
    for number in range(count):
        done, where = threading.Event(), []

        def operation(connection: Connection, where: list[str] = where, number: int = number) -> int:
            where.append(threading.current_thread().name)
            connection.execute("INSERT INTO audit VALUES (NULL, ?, '', '', '', 0, '', '')", (number,))
            return number

        def then(result: int, error: BaseException | None, done: threading.Event = done, number: int = number) -> None:
            assert (result, error) == (number, None)
            done.set()

        database.submit_small(1, then, operation)
        assert done.wait(60)
        database.submit(lambda connection: None).result()  # the writer has nothing at hand any more
        found += where
    return found


def test_small_writes_are_made_where_they_come_from_while_commits_are_quick(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch, 1e-4)
    here = threading.current_thread().name
    with contextlib.closing(Database(tmp_path / "twin.sqlite3")) as database:
        first = written_by(database, 200)
        assert first[0] == "writer"  # of a disk that nobody knows
        assert here in first
        clock.commit_s = 1.0
        assert set(written_by(database, 40)[5:]) == {"writer"}
        clock.commit_s = 1e-4
        assert here in written_by(database, 400)
        assert database.submit(lambda c: c.execute("SELECT count(*) FROM audit").fetchone()[0]).result() == 640


def test_a_small_write_waits_for_those_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Clock(monkeypatch, 1e-4)
    with contextlib.closing(Database(tmp_path / "twin.sqlite3")) as database:
        written_by(database, 200)
        begun, go_on, order = threading.Event(), threading.Event(), []

        def slow(connection: Connection) -> None:
            begun.set()
            assert go_on.wait(60)
            order.append("before")

        before = database.submit(slow)
        assert begun.wait(60)
        after: Future[None] = Future()
        database.submit_small(1, lambda _, error: after.set_result(None), lambda connection: order.append("small"))
        assert not after.done()
        go_on.set()
        before.result(60)
        after.result(60)
        assert order == ["before", "small"]


def test_a_small_write_that_fails_undoes_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Clock(monkeypatch, 1e-4)
    with contextlib.closing(Database(tmp_path / "twin.sqlite3")) as database:
        written_by(database, 200)
        heard: list[BaseException | None] = []

        def fails(connection: Connection) -> None:
            connection.execute("DELETE FROM audit")
            raise RuntimeError("no")

        database.submit_small(1, lambda _, error: heard.append(error), fails)
        database.submit(lambda connection: None).result()
        assert [str(error) for error in heard] == ["no"]
        assert database.submit(lambda c: c.execute("SELECT count(*) FROM audit").fetchone()[0]).result() == 200
