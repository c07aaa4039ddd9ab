"""The database: one writer thread whose transactions many requests share, and readers that never wait for it.

Where a commit is quicker than waking a thread twice, what is small is written by whoever brings it, in its turn.

This is the narrow place through which all SQL goes: ``write(operation, ...)`` and ``read(operation, ...)``, where an
operation is a function of a connection from one of the table modules. Which database it is, an ``Engine`` knows.
"""

import asyncio
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from service.store.connection import Connection
from service.store.engine import Engine
from service.store.errors import DiskFull, Unavailable

P = ParamSpec("P")
T = TypeVar("T")

SHARE = 256
"""Most operations that share one commit."""
READERS = 4
ATTEMPTS = 4
"""So often is a transaction run that others stood in the way of."""
QUICK_S = 0.001
"""What takes longer is worth a thread of its own."""
RECENT = 32
"""So many of the last writes tell how long one takes: each counts by this fraction, more the later it was."""


@dataclass(slots=True)
class _Order:
    """One operation on its way to the writer, which twin it writes to, and where its result goes."""

    operation: Callable[[Connection], Any]
    then: Callable[[Any, BaseException | None], None]
    twin: int | None = None
    result: Any = None
    error: BaseException | None = None


def open_engine(place: Path | str, name: str = "TWIN_DATABASE_URL") -> Engine:
    """Open a database: a SQLite file, or a server by its URL (``postgresql://…``); StoreError if that is impossible.

    ``name`` is what errors call the setting or the argument that named it.
    """
    if isinstance(place, str):
        from service.store.postgres.engine import PostgresEngine

        return PostgresEngine(place, name)
    from service.store.sqlite.engine import SqliteEngine

    return SqliteEngine(place, name)


class Database:
    """An open database."""

    def __init__(self, place: Path | str) -> None:
        """Open and migrate it; StoreError if that is impossible."""
        self.engine = open_engine(place)
        self._session = self.engine.session()
        self._faults: tuple[type[Exception], ...] = (*self.engine.faults, Unavailable, DiskFull)
        self._orders: queue.SimpleQueue[_Order | None] = queue.SimpleQueue()
        self._turn = threading.Lock()
        """Held by whoever writes."""
        self._is_writing = False
        """Whether the writer has something at hand."""
        self._usual_s = 4.0 * QUICK_S
        """What a small write takes, of late; nothing is known of a disk at first."""
        self._readers = ThreadPoolExecutor(READERS, thread_name_prefix="reader")
        self._writer = threading.Thread(target=self._write_forever, name="writer", daemon=True)
        self._writer.start()

    def is_fault(self, error: Exception) -> bool:
        """Return whether an operation failed over the database, not over what it was to do."""
        return isinstance(error, self._faults)

    @property
    def is_shared(self) -> bool:
        """Whether other processes may write to it at the same time."""
        return self.engine.is_shared

    async def write(self, operation: Callable[Concatenate[Connection, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Return the operation's result once it is durably committed."""
        return await asyncio.wrap_future(self.submit(operation, *args, **kwargs))

    async def write_to(
        self, twin: int, operation: Callable[Concatenate[Connection, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """The same for an operation that reads and writes what belongs to a twin: no other write of it comes between."""
        answer: Future[T] = Future()
        self.submit_to(twin, partial(_settle, answer), operation, *args, **kwargs)
        return await asyncio.wrap_future(answer)

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

    def submit_to(
        self,
        twin: int,
        then: Callable[[T, BaseException | None], None],
        operation: Callable[Concatenate[Connection, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> None:
        """The same for what belongs to a twin, see ``write_to``."""
        self._orders.put(_Order(lambda connection: operation(connection, *args, **kwargs), then, twin))

    def submit_small(
        self,
        twin: int,
        then: Callable[[T, BaseException | None], None],
        operation: Callable[Concatenate[Connection, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> None:
        """The same for what writes little: done, and ``then`` called, at once where nobody else writes and commits are quick."""
        order = _Order(lambda connection: operation(connection, *args, **kwargs), then, twin)
        is_alone = not self._is_writing and self._orders.empty()
        if self._usual_s > QUICK_S or not is_alone or not self._turn.acquire(blocking=False):
            self._orders.put(order)
            return
        try:
            begun_s = time.perf_counter()
            self._commit([order])
            self._note(time.perf_counter() - begun_s)
        finally:
            self._turn.release()
        if self._session.is_due:
            self._orders.put(_Order(_nothing, _unheard))

    async def read(self, operation: Callable[Concatenate[Connection, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run an operation on a read-only snapshot, beside the writer and other readers."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(
            self._readers, lambda: self.engine.read(lambda c: operation(c, *args, **kwargs))
        )

    def close(self) -> None:
        """Finish what is queued, then close the database."""
        self._orders.put(None)
        self._writer.join()
        self._readers.shutdown()
        self._session.close()
        self.engine.close()

    @property
    def backlog(self) -> int:
        """Operations that wait for the writer."""
        return self._orders.qsize()

    def _write_forever(self) -> None:
        stop = False
        while not stop:
            orders, stop = self._collect()
            if orders:
                with self._turn:
                    self._commit(orders)
                    if self._session.is_due:
                        self._session.catch_up()
            self._is_writing = False

    def _collect(self) -> tuple[list[_Order], bool]:
        """Wait for one order, then take along what else is queued."""
        orders: list[_Order] = []
        item = self._orders.get()
        self._is_writing = True
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
        for attempt in range(ATTEMPTS):
            for order in orders:
                order.error = None
            try:
                if not self._commit_together(orders):
                    self._commit_apart(orders)
                break
            except self._faults as error:
                self._session.roll_back()
                if attempt + 1 < ATTEMPTS and self.engine.is_passing(error):
                    continue
                for order in orders:
                    order.error = order.error or self._refusal(error)
                break
        for order in orders:
            order.then(order.result, order.error)

    def _commit_together(self, orders: list[_Order]) -> bool:
        """Return whether all orders succeeded and are committed."""
        session = self._session
        session.begin(_twins(orders))
        try:
            for order in orders:
                session.turn(order.twin)
                order.result = order.operation(session.connection)
        except Exception as error:
            session.roll_back()
            if len(orders) > 1:
                return False
            if self.engine.is_passing(error):
                raise
            orders[0].error = self._refusal(error)
            return True
        begun_s = time.perf_counter()
        session.commit()
        if threading.current_thread() is self._writer:
            self._note(time.perf_counter() - begun_s)
        return True

    def _note(self, took_s: float) -> None:
        """Learn how long a write took: of the writer, whose transactions may be large, the commit alone."""
        if not self.is_shared:
            self._usual_s += (took_s - self._usual_s) / RECENT

    def _commit_apart(self, orders: list[_Order]) -> None:
        self._session.begin(_twins(orders))
        for order in orders:
            self._attempt(order)
        self._session.commit()

    def _attempt(self, order: _Order) -> None:
        session = self._session
        session.connection.execute("SAVEPOINT operation")
        try:
            order.result = order.operation(session.connection)
        except self.engine.faults as error:
            if not session.in_transaction or self.engine.is_passing(error):  # a full disk rolls everything back
                raise
            order.error = self._refusal(error)
        except Exception as error:
            order.error = error
        if order.error is not None:
            session.connection.execute("ROLLBACK TO operation")
        session.connection.execute("RELEASE operation")

    def _refusal(self, error: Exception) -> Exception:
        return self.engine.refusal(error) if isinstance(error, self.engine.faults) else error


def _nothing(_: Connection) -> None:
    """Let the writer look what there is to be done."""


def _unheard(_: None, error: BaseException | None) -> None:
    """Tell nobody."""


def _twins(orders: list[_Order]) -> set[int]:
    return {order.twin for order in orders if order.twin is not None}


def _settle(answer: "Future[T]", result: T, error: BaseException | None) -> None:
    """Deliver result or error; a caller that hung up has cancelled its future, which is no reason to stop."""
    if not answer.set_running_or_notify_cancel():
        return
    if error is not None:
        answer.set_exception(error)
    else:
        answer.set_result(result)
