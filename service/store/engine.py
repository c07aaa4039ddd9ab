"""What a database must be able to do so that the store can run on it; SQLite and PostgreSQL are the two that can."""

from collections.abc import Callable, Collection, Mapping
from typing import Protocol, TypeVar

from service.store.connection import Connection

T = TypeVar("T")


class Session(Protocol):
    """The writer's connection and its transactions."""

    @property
    def connection(self) -> Connection:
        """What operations are handed."""

    @property
    def in_transaction(self) -> bool:
        """Whether a transaction is open; a full disk may have ended it."""

    def begin(self, twins: Collection[int]) -> None:
        """Begin a transaction that nobody else's write of these twins can interleave with."""

    def turn(self, twin: int | None) -> None:
        """Hear whose twin's the next statements are; None: they may concern any."""

    def commit(self) -> None:
        """Make it durable."""

    def roll_back(self) -> None:
        """Undo it, if there is one; never raises."""

    @property
    def is_due(self) -> bool:
        """Whether there is something that commits put off, which ``catch_up`` does."""

    def catch_up(self) -> None:
        """Do what commits put off, between two transactions; never raises."""

    def close(self) -> None:
        """Close the connection."""


class Engine(Protocol):
    """A database that is open."""

    faults: tuple[type[Exception], ...]
    """What its driver raises."""
    is_shared: bool
    """Whether other processes may write to it at the same time."""

    chores: tuple[tuple[str, Callable[[Connection], int]], ...]
    """What the database wants done now and then: (of what, a short write that returns how much it did)."""

    def session(self) -> Session:
        """Return the one session that writes; StoreError if there can be none."""

    def read(self, operation: Callable[[Connection], T]) -> T:
        """Run an operation on a read-only snapshot, from any thread."""

    def is_passing(self, error: Exception) -> bool:
        """Return whether a fault came of others who wrote at the same time: the same transaction may succeed now."""

    def refusal(self, error: Exception) -> Exception:
        """Return what the caller is told about a fault."""

    def is_attended(self, connection: Connection) -> bool:
        """Return whether a service or a worker is at work on the database."""

    def after_transfer(self, connection: Connection, keys: Mapping[str, str]) -> None:
        """Go on counting behind what was copied: table -> the column whose numbers the database hands out."""

    def drop_old(self) -> int:
        """Remove at once a part of the archive of which no twin keeps anything; return how many segments went, 0: none."""

    def close(self) -> None:
        """Let go of everything."""
