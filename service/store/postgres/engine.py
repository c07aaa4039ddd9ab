"""A PostgreSQL server: connections that speak the store's dialect, and transactions that many processes share."""

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, TypeVar

import psycopg
from psycopg import errors

from service.store import ownership, segments
from service.store.connection import Connection, Cursor
from service.store.errors import DiskFull, StoreError, Unavailable
from service.store.postgres import partitions
from service.store.postgres.migrations import migrate
from service.store.postgres.stage import Stage

log = logging.getLogger("service.store")
T = TypeVar("T")

CONNECT_S = 5
RETRY_S = 1.0
"""After a server could not be reached, writes are refused for so long before the next attempt."""
SETTINGS = {
    "application_name": "thermal-twin",
    "connect_timeout": CONNECT_S,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 8000,
}
IDLE_S = 5
"""A client that vanishes inside of a transaction, by a cut cable say, holds its locks no longer: as long as a lease lasts."""
OPTIONS = f"-c synchronous_commit=on -c idle_in_transaction_session_timeout={1000 * IDLE_S} -c lock_timeout=20000"

PASSING = (
    errors.DeadlockDetected,
    errors.SerializationFailure,
    errors.CheckViolation,
    errors.IdleInTransactionSessionTimeout,
)


class Speaking:
    """A connection of the driver that takes the store's dialect."""

    def __init__(self, driver: "psycopg.Connection[Any]") -> None:
        """Take over an open connection."""
        self.driver = driver
        self.stage: Stage | None = None

    def execute(self, query: str, parameters: Sequence[Any] = (), /) -> Cursor:
        """Run one statement."""
        if self.stage is not None:
            self.stage.make_way()
        return self.driver.execute(_translated(query), parameters, binary=True)  # type: ignore[arg-type]

    def executemany(self, query: str, parameters: Iterable[Sequence[Any]], /) -> Cursor:
        """Run one statement once for each row of parameters."""
        if self.stage is not None:
            self.stage.make_way()
        cursor = self.driver.cursor(binary=True)
        cursor.executemany(_translated(query), parameters)  # type: ignore[arg-type]
        return cursor


@lru_cache(maxsize=512)
def _translated(query: str) -> str:
    """Return a statement with the driver's placeholders; none of the store's statements holds a question mark in a text."""
    return query.replace("%", "%%").replace("?", "%s")


def connect(url: str) -> "psycopg.Connection[Any]":
    """Return a connection of the driver; Unavailable if the server cannot be reached, without what is secret of the URL."""
    if (
        url.partition("?")[0].count("@") > 1
    ):  # libpq would look for the rest of the password among the hosts, and name it
        raise Unavailable("write @ as %40 in the user and the password of the database's URL")
    try:
        own = psycopg.conninfo.conninfo_to_dict(url).get("options", "")
        return psycopg.connect(url, autocommit=True, options=f"{OPTIONS} {own}", **SETTINGS)  # type: ignore[arg-type]
    except (psycopg.OperationalError, psycopg.ProgrammingError) as error:
        raise Unavailable(f"the database cannot be reached: {_without_secrets(error, url)}") from None


def _without_secrets(error: Exception, url: str) -> str:
    """Return the last line of an error without the password, wherever it stands."""
    said = " ".join(str(error).split())
    try:
        password = psycopg.conninfo.conninfo_to_dict(url).get("password")
    except psycopg.ProgrammingError:
        return "it is no URL of a PostgreSQL database"
    return (said.replace(str(password), "***") if password else said)[:300]


class PostgresSession:
    """The connection that writes; it is made anew when the server comes back."""

    def __init__(self, url: str) -> None:
        """Connect; Unavailable if the server cannot be reached."""
        self._url = url
        self._speak()
        self._not_before_s = 0.0

    @property
    def connection(self) -> Connection:
        """What operations are handed."""
        return self._speaking

    @property
    def in_transaction(self) -> bool:
        """Whether the connection lives: a fault inside of a savepoint leaves the transaction open."""
        return not self._speaking.driver.broken and not self._speaking.driver.closed

    def begin(self, twins: Collection[int]) -> None:
        """Begin a transaction and lock the heads of these twins."""
        if not self.in_transaction:
            self._connect()
        if twins:
            self._stage.begin(twins)
        else:
            self._speaking.driver.execute("BEGIN")

    def turn(self, twin: int | None) -> None:
        """Hear whose twin's the next statements are; None: they may concern any."""
        self._stage.turn(twin)

    def commit(self) -> None:
        """Make it durable."""
        if not self._stage.due:
            self._stage.flush("COMMIT")
        else:
            self._stage.flush()
            self._stage.turn(None)
            with self._speaking.driver.pipeline():
                segments.compact(self._speaking, self._stage.due)
                self._speaking.driver.execute("COMMIT")
        self._stage.end()

    def roll_back(self) -> None:
        """Undo it; a connection that cannot even do that is given up."""
        self._stage.end()
        self._stage.rooms.clear()
        try:
            self._speaking.driver.execute("ROLLBACK")
        except psycopg.Error:
            self._speaking.driver.close()

    is_due = False

    def catch_up(self) -> None:
        """Do nothing: the server looks after its log itself."""

    def close(self) -> None:
        """Close the connection."""
        self._speaking.driver.close()

    def _connect(self) -> None:
        if time.monotonic() < self._not_before_s:
            raise Unavailable("the database cannot be reached; send it again")
        self._not_before_s = time.monotonic() + RETRY_S
        self._speak()
        log.warning("the database is there again")

    def _speak(self) -> None:
        self._speaking = Speaking(connect(self._url))
        self._stage = self._speaking.stage = Stage(self._speaking.driver, self._make_rooms)

    def _make_rooms(self, instants: Iterable[int]) -> dict[str, tuple[int, int]]:
        with connect(self._url) as driver:  # not in the transaction that is open: its locks would be waited for
            return partitions.make(Speaking(driver), instants)


class PostgresEngine:
    """One database of a server."""

    faults: tuple[type[Exception], ...] = (psycopg.Error,)
    is_shared = True
    chores: tuple[tuple[str, Callable[[Connection], int]], ...] = ()

    def __init__(self, url: str, name: str) -> None:
        """Connect and migrate; StoreError if that is impossible, with the ``name`` under which the URL was given."""
        self.url, self._name = url, name
        self._local = threading.local()
        self._opened: list[psycopg.Connection[Any]] = []
        try:
            with connect(url) as driver:
                migrate(Speaking(driver))
        except Unavailable as error:
            raise StoreError(f"{name}: {error.detail}") from None
        except psycopg.Error as error:
            said = _without_secrets(error, url)
            raise StoreError(f"{name}: the database cannot be used ({said})") from None

    def session(self) -> PostgresSession:
        """Return the session that writes."""
        try:
            return PostgresSession(self.url)
        except Unavailable as error:
            raise StoreError(f"{self._name}: {error.detail}") from None

    def read(self, operation: Callable[[Connection], T]) -> T:
        """Run an operation on a snapshot; once more if the connection turns out to be dead."""
        try:
            return self._read(operation)
        except psycopg.OperationalError:
            return self._read_anew(operation)

    def _read_anew(self, operation: Callable[[Connection], T]) -> T:
        try:
            return self._read(operation)
        except psycopg.OperationalError as error:
            raise self.refusal(error) from None

    def _read(self, operation: Callable[[Connection], T]) -> T:
        speaking: Speaking | None = getattr(self._local, "connection", None)
        if speaking is None or speaking.driver.closed or speaking.driver.broken:
            speaking = self._local.connection = Speaking(connect(self.url))
            self._opened.append(speaking.driver)
        speaking.execute("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY")
        try:
            return operation(speaking)
        finally:
            try:
                speaking.execute("ROLLBACK")
            except psycopg.Error:
                speaking.driver.close()

    def is_passing(self, error: Exception) -> bool:
        """Return whether transactions stood in each other's way, a partition was dropped that a segment was to go into, or this
        process stood still for so long that its transaction was ended."""
        return isinstance(error, PASSING)

    def refusal(self, error: Exception) -> Exception:
        """Return what the caller is told about a fault."""
        if isinstance(error, errors.DiskFull):
            log.error("the database's disk is full; nothing of the write was stored")
            return DiskFull("the disk is full: nothing of this request was stored; free some space and send it again")
        if isinstance(
            error, psycopg.OperationalError | errors.ReadOnlySqlTransaction | errors.IdleInTransactionSessionTimeout
        ):
            log.error("the database does not answer", extra={"reason": _without_secrets(error, self.url)})
            return Unavailable("the database cannot be reached; send it again: what is stored already is recognised")
        return error

    def is_attended(self, connection: Connection) -> bool:
        """Return whether a service or a worker is at work on the database."""
        return ownership.is_attended(connection)

    def after_transfer(self, connection: Connection, keys: Mapping[str, str]) -> None:
        """Let each sequence go on behind the rows that were copied."""
        for table, column in keys.items():
            query = (
                f"SELECT setval(pg_get_serial_sequence('{table}', '{column}'), greatest(max({column}), 1)) FROM {table}"
            )
            connection.execute(query)

    def drop_old(self) -> int:
        """Drop a quarter of which no twin keeps anything, on a connection that holds no locks."""
        try:
            with connect(self.url) as driver:
                return partitions.drop_one(Speaking(driver))
        except psycopg.Error as error:
            raise self.refusal(error) from None

    def close(self) -> None:
        """Close the readers' connections."""
        for driver in self._opened:
            driver.close()
