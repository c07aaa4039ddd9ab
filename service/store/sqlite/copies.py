"""Whole copies of the database: backups while the service runs, restoring one, and migrations on trial."""

import contextlib
import os
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from service.store.connection import Connection
from service.store.errors import StoreError
from service.store.sqlite import migrations
from service.store.sqlite.lock import FileLock


@dataclass(frozen=True)
class Contents:
    """What a database holds, as far as one look tells."""

    twins: int
    samples: int
    models: int
    steps: int

    @property
    def words(self) -> str:
        """The same in words."""
        return f"{self.twins} twins, {self.samples:,} samples, {self.models} models"


def backup(source: Path, target: Path) -> Contents:
    """Write a consistent copy beside a running service, check it and return what it holds.

    Raises
    ------
    StoreError
        If the source is no database of the service, the target exists, or the copy is not what the source was.
    """
    if target.exists():
        raise StoreError(f"{target}: exists already; choose another name or remove it")
    part = target.with_name(target.name + ".part")
    with _opened(source) as connection:
        _look(connection, source)
        try:
            _write(connection, part)
        except (OSError, sqlite3.Error) as error:
            part.unlink(missing_ok=True)
            raise StoreError(f"{target}: cannot be written ({error})") from error
    contents = check(part)
    with part.open("rb+") as file:
        os.fsync(file.fileno())
    part.rename(target)
    return contents


def check(path: Path) -> Contents:
    """Read a database from end to end; return what it holds, or StoreError if anything is amiss."""
    with _opened(path) as connection:
        try:
            problems = [row[0] for row in connection.execute("PRAGMA integrity_check(3)") if row[0] != "ok"]
            orphans = connection.execute("PRAGMA foreign_key_check").fetchall()
        except sqlite3.Error as error:
            raise StoreError(f"{path}: is damaged ({error})") from error
        if problems or orphans:
            raise StoreError(
                f"{path}: is damaged ({problems[0] if problems else f'{len(orphans)} rows belong to nothing'})"
            )
        contents = _look(connection, path)
        stored = connection.execute("SELECT coalesce(sum(n), 0) FROM chunk").fetchone()[0]
        if stored < contents.samples:
            raise StoreError(f"{path}: is damaged (it says {contents.samples} samples and holds {stored})")
        return contents


def restore(copy: Path, target: Path) -> tuple[Contents, Path | None]:
    """Put a copy in the place of a database that no server uses; return what it holds, and where the former one is now.

    Raises
    ------
    StoreError
        If the copy is damaged, or a server uses the target.
    """
    contents = check(copy)
    lock = FileLock(target)
    try:
        part = target.with_name(target.name + ".part")
        with _opened(copy) as connection:
            _write(connection, part)
        if check(part) != contents:
            raise StoreError(f"{copy}: could not be copied whole")
        former = None
        if target.exists() and target.stat().st_size:
            former = target.with_name(f"{target.name}.before-{int(time.time())}")
            with _opened(target) as connection:  # what its journal holds belongs to it
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            target.rename(former)
        for suffix in ("-wal", "-shm"):
            target.with_name(target.name + suffix).unlink(missing_ok=True)
        part.rename(target)
    finally:
        lock.release()
    return contents, former


@dataclass(frozen=True)
class Rehearsal:
    """A migration on trial: its steps, how long they took, and what the database held before and after."""

    steps: tuple[str, ...]
    elapsed_s: float
    before: Contents
    after: Contents


def rehearse(source: Path, folder: Path) -> Rehearsal:
    """Migrate a copy of a database, which stays as it is, and check the copy afterwards.

    Raises
    ------
    StoreError
        If a step fails, or the copy is damaged afterwards.
    """
    copy = folder / "rehearsal.sqlite3"
    before = backup(source, copy)
    begun_s = time.monotonic()
    with contextlib.closing(sqlite3.connect(copy, isolation_level=None)) as connection:
        connection.execute("PRAGMA foreign_keys = ON")
        try:
            steps = migrations.migrate(connection)
        except sqlite3.Error as error:
            raise StoreError(f"{source}: cannot be migrated ({error})") from error
    return Rehearsal(tuple(steps), time.monotonic() - begun_s, before, check(copy))


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Connection]:
    """Yield a connection that leaves the file as it is, though others write to it."""
    if not path.is_file():
        raise StoreError(f"{path}: there is no such file")
    with contextlib.closing(sqlite3.connect(path, isolation_level=None, timeout=30.0)) as connection:
        yield connection


def _write(connection: Connection, part: Path) -> None:
    """Write a copy that only its owner may read: it holds the secrets of webhooks."""
    part.unlink(missing_ok=True)
    os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
    connection.execute("PRAGMA auto_vacuum = INCREMENTAL")
    connection.execute("VACUUM INTO ?", (str(part),))  # an empty file may stand there


def _look(connection: Connection, path: Path) -> Contents:
    queries = (
        "SELECT count(*) FROM head",
        "SELECT coalesce(sum(samples), 0) FROM head",
        "SELECT count(*) FROM model",
        "SELECT count(*) FROM migration",
    )
    try:
        return Contents(*(int(connection.execute(query).fetchone()[0]) for query in queries))
    except sqlite3.Error as error:
        raise StoreError(f"{path}: is no database of the service ({error})") from error
