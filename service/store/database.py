"""The database: one writer thread whose transactions many requests share, and readers that never wait for it.

This is the narrow place through which all SQL goes: ``write(operation, ...)`` and ``read(operation, ...)``, where an
operation is a function of a connection from one of the table modules. Another database needs its own connection here
and its own table modules, nothing else.
"""

import asyncio
import contextlib
import logging
import queue
import sqlite3
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from service.store.connection import Connection
from service.store.errors import DiskFull, StoreError
from service.store.lock import FileLock
from service.store.migrations import migrate

log = logging.getLogger("service.store")

P = ParamSpec("P")
T = TypeVar("T")

SHARE = 256
"""Most operations that share one commit."""
READERS = 4
PRAGMAS = (
    "auto_vacuum = INCREMENTAL",  # holds for new files; others keep what they were made with
    "journal_mode = WAL",
    "synchronous = FULL",
    "foreign_keys = ON",
    "mmap_size = 268435456",
    "temp_store = MEMORY",
)
FULL = ("SQLITE_FULL", "SQLITE_IOERR_WRITE", "SQLITE_IOERR_FSYNC", "SQLITE_IOERR_SHMSIZE")


@dataclass(slots=True)
class _Order:
    """One operation on its way to the writer, and where its result goes."""

    operation: Callable[[Connection], Any]
    then: Callable[[Any, BaseException | None], None]
    result: Any = None
    error: BaseException | None = None


class Database:
    """An open database file."""

    def __init__(self, path: Path) -> None:
        """Lock, open and migrate the file; StoreError if that is impossible."""
        self._path = path
        self._lock = FileLock(path)
        try:
            self._connection = _open(path)
        except sqlite3.Error as error:
            self._lock.release()
            raise StoreError(f"{path}: cannot be used as a database ({error}); check TWIN_DATABASE_URL") from error
        self._orders: queue.SimpleQueue[_Order | None] = queue.SimpleQueue()
        self._local = threading.local()
        self._opened: list[Connection] = []
        self._readers = ThreadPoolExecutor(READERS, thread_name_prefix="reader")
        self._writer = threading.Thread(target=self._write_forever, name="writer", daemon=True)
        self._writer.start()

    async def write(self, operation: Callable[Concatenate[Connection, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Return the operation's result once it is durably committed."""
        return await asyncio.wrap_future(self.submit(operation, *args, **kwargs))

    def submit(
        self, operation: Callable[Concatenate[Connection, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> "Future[T]":
        """Queue an operation for the writer, from any thread."""
        answer: Future[T] = Future()
        self.submit_then(partial(_settle, answer), operation, *args, **kwargs)
        return answer

    def submit_then(
        self,
        then: Callable[[T, BaseException | None], None],
        operation: Callable[Concatenate[Connection, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> None:
        """The same; after the commit the writer calls ``then`` with the result, or with the error."""
        self._orders.put(_Order(lambda connection: operation(connection, *args, **kwargs), then))

    async def read(self, operation: Callable[Concatenate[Connection, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run an operation on a read-only snapshot, beside the writer and other readers."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._readers, lambda: self._read(lambda c: operation(c, *args, **kwargs)))

    def close(self) -> None:
        """Finish what is queued, then close the file and release its lock."""
        self._orders.put(None)
        self._writer.join()
        self._readers.shutdown()
        for connection in self._opened:
            connection.close()
        self._connection.close()
        self._lock.release()

    @property
    def backlog(self) -> int:
        """Operations that wait for the writer."""
        return self._orders.qsize()

    def _read(self, operation: Callable[[Connection], T]) -> T:
        connection: Connection | None = getattr(self._local, "connection", None)
        if connection is None:
            connection = _connect(self._path, read_only=True)
            self._local.connection = connection
            self._opened.append(connection)
        connection.execute("BEGIN")
        try:
            return operation(connection)
        finally:
            connection.execute("ROLLBACK")

    def _write_forever(self) -> None:
        stop = False
        while not stop:
            orders, stop = self._collect()
            if orders:
                self._commit(orders)

    def _collect(self) -> tuple[list[_Order], bool]:
        """Wait for one order, then take along what else is queued."""
        orders: list[_Order] = []
        item = self._orders.get()
        while item is not None:
            orders.append(item)
            if len(orders) == SHARE:
                return orders, False
            try:
                item = self._orders.get_nowait()
            except queue.Empty:
                return orders, False
        return orders, True

    def _commit(self, orders: list[_Order]) -> None:
        """Run the orders in one transaction and answer them after the commit.

        Nearly always all of them succeed. If one fails, everything is undone and done again with each order in a
        savepoint of its own, so that it undoes itself alone.
        """
        try:
            if not self._commit_together(orders):
                self._commit_apart(orders)
        except sqlite3.Error as error:
            self._roll_back()
            for order in orders:
                order.error = order.error or _refusal(error)
        for order in orders:
            order.then(order.result, order.error)

    def _commit_together(self, orders: list[_Order]) -> bool:
        """Return whether all orders succeeded and are committed."""
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            for order in orders:
                order.result = order.operation(self._connection)
        except Exception as error:
            self._roll_back()
            if len(orders) > 1:
                return False
            orders[0].error = _refusal(error) if isinstance(error, sqlite3.Error) else error
            return True
        self._connection.execute("COMMIT")
        return True

    def _commit_apart(self, orders: list[_Order]) -> None:
        self._connection.execute("BEGIN IMMEDIATE")
        for order in orders:
            self._attempt(order)
        self._connection.execute("COMMIT")

    def _attempt(self, order: _Order) -> None:
        self._connection.execute("SAVEPOINT operation")
        try:
            order.result = order.operation(self._connection)
        except sqlite3.Error as error:
            if not self._connection.in_transaction:  # a full disk rolls the whole transaction back
                raise
            order.error = _refusal(error)
        except Exception as error:
            order.error = error
        if order.error is not None:
            self._connection.execute("ROLLBACK TO operation")
        self._connection.execute("RELEASE operation")

    def _roll_back(self) -> None:
        if self._connection.in_transaction:
            with contextlib.suppress(sqlite3.Error):  # the commit's own error is the one to report
                self._connection.execute("ROLLBACK")


def _settle(answer: "Future[T]", result: T, error: BaseException | None) -> None:
    """Deliver result or error; a caller that hung up has cancelled its future, which is no reason to stop."""
    if not answer.set_running_or_notify_cancel():
        return
    if error is not None:
        answer.set_exception(error)
    else:
        answer.set_result(result)


def _refusal(error: sqlite3.Error) -> Exception:
    """Return what the caller is told about a failed write."""
    name = getattr(error, "sqlite_errorname", "")
    if name.startswith(FULL):
        log.error("the disk is full; nothing of the write was stored", extra={"sqlite": name})
        return DiskFull("the disk is full: nothing of this request was stored; free some space and send it again")
    return error


def _open(path: Path) -> Connection:
    """Return the writer's connection to a database of the present schema."""
    connection = _connect(path)
    try:
        migrate(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def _connect(path: Path, read_only: bool = False) -> Connection:
    connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=10.0)
    settings = PRAGMAS + (("query_only = ON",) if read_only else ())
    try:
        for setting in settings:
            connection.execute(f"PRAGMA {setting}")
    except sqlite3.Error:
        connection.close()
        raise
    return connection
