"""The connection that every operation of the store is handed: the one dialect of SQL that both databases speak.

Parameters are ``?``. What the two databases do not share is written so that both understand it: ``RETURNING`` instead of a row
id, ``ON CONFLICT`` instead of ``REPLACE``, ``CASE`` instead of a least or greatest of two values.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

Row = tuple[Any, ...]


class Cursor(Protocol):
    """The rows of one statement."""

    @property
    def rowcount(self) -> int:
        """How many rows a statement changed."""

    def fetchone(self) -> Any:
        """Return the next row, None after the last one."""

    def fetchall(self) -> list[Any]:
        """Return the rows that are left."""

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the rows that are left."""


class Connection(Protocol):
    """A connection inside a transaction, which begins and ends elsewhere."""

    def execute(self, query: str, parameters: Sequence[Any] = ..., /) -> Cursor:
        """Run one statement."""

    def executemany(self, query: str, parameters: Iterable[Sequence[Any]], /) -> Cursor:
        """Run one statement once for each row of parameters."""


@dataclass(slots=True)
class Head:
    """Where the archive of a twin stands, as far as what is appended to it depends on that and changes it."""

    seq: int
    last_us: int | None
    small_chunks: int
    small_rows: int


class Stage(Protocol):
    """Where segments of a transaction wait, so that few statements store all of them; some connections have one."""

    def head(self, twin: int) -> Head | None:
        """Return where a twin stands, whose archive this transaction has locked; None where that is not known."""

    def make_room(self, instants: Iterable[int]) -> None:
        """Let there be a place for segments that begin at some instants."""

    def put(self, segment: Row) -> None:
        """Store a segment that lies behind all of its twin, moving the twin's head: at the latest with the commit."""

    def compact_later(self, twin: int, n_rows: int) -> None:
        """Let the small segments of a twin, of so many rows, be compacted with the commit."""
