"""Segments of many twins on their way into one table: COPY into a stage, then one INSERT … SELECT that moves the heads, too."""

from collections.abc import Callable, Iterable
from itertools import chain
from typing import Any

import psycopg

from service.store.connection import Head, Row

LOCK = """SELECT twin, seq, last_us, small_chunks, small_rows FROM head WHERE twin IN ({}) ORDER BY twin FOR UPDATE"""
COLUMNS = {
    **dict.fromkeys(("twin", "n", "first_us", "last_us", "last_seq"), "int8"),
    **dict.fromkeys(("seq", "time", "value", "received"), "bytea"),
}
MAKE = f"""CREATE TEMPORARY TABLE stage ({", ".join(f"{name} {kind}" for name, kind in COLUMNS.items())})
           ON COMMIT DELETE ROWS"""
STORE = """WITH staged ({names}) AS ({source}),
           taken AS (SELECT twin, sum(n) AS n, count(*) AS chunks, min(first_us) AS first_us, max(last_us) AS last_us
                     FROM staged GROUP BY twin),
           moved AS (UPDATE head SET seq = head.seq + taken.n, samples = head.samples + taken.n,
                     first_us = least(head.first_us, taken.first_us), last_us = taken.last_us,
                     small_chunks = head.small_chunks + taken.chunks, small_rows = head.small_rows + taken.n
                     FROM taken WHERE head.twin = taken.twin AND (head.last_us IS NULL OR head.last_us < taken.first_us)
                     RETURNING head.twin)
           INSERT INTO chunk ({names}) SELECT {names} FROM staged WHERE twin IN (SELECT twin FROM moved) ORDER BY last_seq"""
"""What a head has passed is in the archive and does not enter it again."""
NAMES = ", ".join(COLUMNS)
STORE_STAGED = f"""CREATE FUNCTION pg_temp.store_staged() RETURNS void LANGUAGE plpgsql AS
                   $$BEGIN {STORE.format(names=NAMES, source=f"SELECT {NAMES} FROM stage")}; END$$"""
"""A function keeps its plan while the connection lives, and travels with COMMIT as one message. What the driver prepares by
itself needs its pipeline for that, which costs the client more than all rows of a commit."""
Rooms = dict[str, tuple[int, int]]
"""Partitions and the instants, start <= first_us < stop, that they are for."""
FEW = 4
"""So many segments go along with the statement itself: a stage costs more than it saves."""


class Stage:
    """What waits in the transaction of one connection."""

    def __init__(self, driver: "psycopg.Connection[Any]", make: Callable[[Iterable[int]], Rooms]) -> None:
        """Hold nothing; ``make`` makes partitions for segments that begin at some instants, and tells which there are."""
        self._driver, self._make = driver, make
        for statement in (MAKE, STORE_STAGED):
            driver.execute(statement)  # type: ignore[arg-type]
        self.rooms: Rooms = {}
        self.due: dict[int, int] = {}
        self._heads: dict[int, Head] = {}
        self._rows: list[Row] = []
        self._turn: int | None = None
        self._is_used = False

    def begin(self, twins: Iterable[int]) -> None:
        """Begin a transaction and lock the heads of these twins, in one order everywhere so that nobody waits in a circle."""
        found = self._together("BEGIN", LOCK.format(", ".join(map(str, twins))))
        self._heads = {twin: Head(*head) for twin, *head in found}

    def end(self) -> None:
        """Forget the transaction, whatever became of it."""
        self._heads, self._rows, self._turn, self._is_used = {}, [], None, False
        self.due = {}

    def turn(self, twin: int | None) -> None:
        """Hear whose twin's the next statements are; None: they may concern any."""
        self._turn = twin

    def head(self, twin: int) -> Head | None:
        """Return where a twin stands, as long as only segments have been put behind it."""
        return self._heads.get(twin) if twin == self._turn else None

    def make_room(self, instants: Iterable[int]) -> None:
        """Make the partitions that segments need which begin at some instants, as far as they are not known to be there."""
        missing = list(instants)
        for first, stop in self.rooms.values():
            missing = [t for t in missing if not first <= t < stop]
        if missing:
            self.rooms = self._make(missing)
            name = next(name for name, (first, stop) in self.rooms.items() if first <= missing[0] < stop)
            self._driver.execute(f"SELECT FROM {name} LIMIT 0")  # type: ignore[arg-type]  # a lock, with which news is heard

    def put(self, segment: Row) -> None:
        """Let a segment wait."""
        self._rows.append(segment)

    def compact_later(self, twin: int, n_rows: int) -> None:
        """Note that the small segments of a twin are to be compacted with the commit."""
        self.due[twin] = n_rows

    def make_way(self) -> None:
        """Let other statements find what was put here of the twin whose turn it is, and move its head."""
        if self._turn is None or any(row[0] == self._turn for row in self._rows):
            self.flush()
        if self._turn is None:
            self._heads.clear()
        else:
            self._heads.pop(self._turn, None)

    def flush(self, *after: str) -> None:
        """Store what waits, and run statements that follow in the same round trip."""
        rows, self._rows = self._rows, []
        if rows:
            self.make_room(row[2] for row in rows)
        if 0 < len(rows) <= FEW:
            place = f"({', '.join(f'%s::{kind}' for kind in COLUMNS.values())})"
            store = STORE.format(names=NAMES, source=f"VALUES {', '.join([place] * len(rows))}")
            with self._driver.pipeline():
                self._driver.execute(store, list(chain(*rows)))  # type: ignore[arg-type]
                for statement in after:
                    self._driver.execute(statement)  # type: ignore[arg-type]
        elif rows:
            self._copy(rows)
            self._together("SELECT pg_temp.store_staged()", *after)
        elif after:
            self._together(*after)

    def _together(self, *statements: str) -> "psycopg.Cursor[Any]":
        """Run statements in one round trip; return the last one's answer."""
        cursor = self._driver.execute("; ".join(statements), prepare=False)  # type: ignore[arg-type]
        while cursor.nextset():
            pass
        return cursor

    def _copy(self, rows: Iterable[Row]) -> None:
        """Let the stage hold segments, and nothing else."""
        if self._is_used:
            self._driver.execute("TRUNCATE stage")
        self._is_used = True
        with self._driver.cursor().copy("COPY stage FROM STDIN (FORMAT BINARY)") as copy:
            copy.set_types(list(COLUMNS.values()))
            for row in rows:
                copy.write_row(row)
