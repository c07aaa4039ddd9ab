"""The file: its locks, its connections and how they are set up."""

import contextlib
import logging
import sqlite3
import threading
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TypeVar

from service.instants import now_us
from service.store.connection import Connection
from service.store.errors import DiskFull, StoreError
from service.store.sqlite.lock import FileLock
from service.store.sqlite.migrations import migrate
from service.store.sqlite.vacuum import vacuum

log = logging.getLogger("service.store")
T = TypeVar("T")

COMMITS = 128
"""After so many commits the log is copied into the file; a commit does so itself only where it has become much longer, of few
but large ones."""

ALL = ("mmap_size = 268435456", "temp_store = MEMORY")
READER = (*ALL, "query_only = ON")
WRITER = (*ALL, "journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON", "wal_autocheckpoint = 4000")
NEW_FILE = ("auto_vacuum = INCREMENTAL",)
"""How a connection is set up; what writes to a file is set where it must be: a full disk must stop no reader."""
FULL = ("SQLITE_FULL", "SQLITE_IOERR_WRITE", "SQLITE_IOERR_FSYNC", "SQLITE_IOERR_SHMSIZE")


class SqliteSession:
    """The only connection that writes."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        """Take over an open connection."""
        self.connection = connection
        self._commits = 0
        """Since the log was last copied into the file."""

    @property
    def in_transaction(self) -> bool:
        """Whether a transaction is open."""
        return self.connection.in_transaction

    def begin(self, twins: Collection[int]) -> None:
        """Begin a transaction; nobody else writes at all."""
        self.connection.execute("BEGIN IMMEDIATE")

    def turn(self, twin: int | None) -> None:
        """Write each statement as it comes."""

    def commit(self) -> None:
        """Make it durable."""
        self.connection.execute("COMMIT")
        self._commits += 1

    def roll_back(self) -> None:
        """Undo it, if there is one."""
        if self.connection.in_transaction:
            with contextlib.suppress(sqlite3.Error):  # the commit's own error is the one to report
                self.connection.execute("ROLLBACK")

    @property
    def is_due(self) -> bool:
        """Whether the log has grown enough to be copied into the file, which no commit is to wait for."""
        return self._commits >= COMMITS

    def catch_up(self) -> None:
        """Copy it, as far as no reader needs the file as it is."""
        self._commits = 0
        with contextlib.suppress(sqlite3.Error):  # a full disk is told by the next write
            self.connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()


class SqliteEngine:
    """One database file, locked against other servers."""

    faults: tuple[type[Exception], ...] = (sqlite3.Error,)
    is_shared = False
    chores: tuple[tuple[str, Callable[[Connection], int]], ...] = (("free pages", vacuum),)

    def __init__(self, path: Path, name: str = "TWIN_DATABASE_URL") -> None:
        """Lock, open and migrate the file; StoreError if that is impossible, with the ``name`` under which it was given."""
        self._path = path
        self._lock = FileLock(path, name)
        self._local = threading.local()
        self._opened: list[sqlite3.Connection] = []
        _tell_if_open(path)
        try:
            self._writer = _open(path)
        except sqlite3.Error as error:
            self._lock.release()
            raise StoreError(f"{path}: cannot be used as a database ({error}); check {name}") from error

    def session(self) -> SqliteSession:
        """Return the session that writes."""
        return SqliteSession(self._writer)

    def read(self, operation: Callable[[Connection], T]) -> T:
        """Run an operation on a snapshot, on a connection of the calling thread's own."""
        connection: sqlite3.Connection | None = getattr(self._local, "connection", None)
        if connection is None:
            connection = _connect(self._path, read_only=True)
            self._local.connection = connection
            self._opened.append(connection)
        connection.execute("BEGIN")
        try:
            return operation(connection)
        finally:
            connection.execute("ROLLBACK")

    def is_passing(self, error: Exception) -> bool:
        """Return False: nobody else writes."""
        return False

    def refusal(self, error: Exception) -> Exception:
        """Return what the caller is told about a failed write."""
        name = getattr(error, "sqlite_errorname", "")
        if name.startswith(FULL):
            log.error("the disk is full; nothing of the write was stored", extra={"sqlite": name})
            return DiskFull("the disk is full: nothing of this request was stored; free some space and send it again")
        return error

    def is_attended(self, connection: Connection) -> bool:
        """Return False: whoever opens the file has it for itself."""
        return False

    def after_transfer(self, connection: Connection, keys: Mapping[str, str]) -> None:
        """Do nothing: SQLite looks at the rows itself."""

    def drop_old(self) -> int:
        """Return 0: a file has no such parts."""
        return 0

    def close(self) -> None:
        """Close the readers' connections and release the file."""
        for connection in self._opened:
            connection.close()
        self._lock.release()


def _tell_if_open(path: Path) -> None:
    """Warn of a file that others may read; it stays as it is, since somebody may have meant it."""
    mode = path.stat().st_mode & 0o777
    if mode & 0o044:
        told = "others may read the database, which holds the secrets of webhooks; chmod 600 ends that"
        log.warning(told, extra={"file": str(path), "mode": f"{mode:04o}"})


def _open(path: Path) -> sqlite3.Connection:
    """Return the writer's connection to a database of the present schema."""
    connection = _connect(path)
    try:
        migrate(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def _connect(path: Path, read_only: bool = False) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=10.0)
    connection.create_function("clock_us", 0, now_us)
    try:
        is_new = connection.execute("PRAGMA page_count").fetchone()[0] == 0
        for setting in READER if read_only else (NEW_FILE if is_new else ()) + WRITER:
            connection.execute(f"PRAGMA {setting}")
    except sqlite3.Error:
        connection.close()
        raise
    return connection
