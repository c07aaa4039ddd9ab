"""Why samples are stored as they are: beside COPY into a stage with one INSERT … SELECT, and beside a table that is not divided.

On a PostgreSQL server with fsync on, all in one run: ingest of batches of several sizes, reading one day of four years, and
what retention costs when it deletes segments and when it drops quarters. ``python -m benchmarks.fleet_store`` writes
``benchmarks/tables/fleet_store.md``, on which ADR 0007 rests.
"""

import contextlib
import os
import time
from collections.abc import Callable, Sequence

import numpy as np
import psycopg

from benchmarks.fleet_ingest import (
    BEGIN_US,
    CHANNELS,
    SHARE,
    copied_and_merged,
    in_turn,
    one_by_one,
    share_of,
    specification,
    through_the_store,
)
from benchmarks.markdown import markdown_table, save_table
from service.store import retention, segments, twins
from service.store.batch import Batch
from service.store.connection import Connection
from service.store.database import Database
from service.store.retention import Retention
from service.store.segments import WITHIN, within
from tests.service.postgres import fresh_database, own_server

TWINS, DAYS, KEPT_DAYS, ROWS_A_DAY = 10, 1460, 730, 144
DAY_US = 86_400_000_000
INGEST_TWINS = 50
SHAPES = ((200, 12, SHARE), (10, 16, 4 * SHARE), (1, 16, 4 * SHARE))
"""Samples in a batch, blocks, batches in a block."""
READS = 200

Server = psycopg.Connection[tuple[object, ...]]
Tell = Callable[..., None]
"""Adds a row of cells to the table."""


def fill(database: Database, server: Server) -> None:
    """Store a segment a day for each twin, in the store's table and in one that is not divided."""
    values = np.random.default_rng(0).normal(290, 5, (CHANNELS, ROWS_A_DAY))
    steps_us = BEGIN_US + np.arange(ROWS_A_DAY, dtype=np.int64) * (DAY_US // ROWS_A_DAY)
    for key in (database.submit(twins.register, f"s{k}", specification(f"s{k}")).result()[0].key for k in range(TWINS)):

        def write(connection: Connection, key: int = key) -> None:
            """Store the segments of one twin and move its head."""
            for day in range(DAYS):
                seq = np.arange(1, ROWS_A_DAY + 1) + day * ROWS_A_DAY
                time_us = day * DAY_US + steps_us
                segments.insert(connection, key, seq, Batch(time_us, values, time_us))
            connection.execute(
                "UPDATE head SET seq = ?, samples = ?, first_us = ?, last_us = ? WHERE twin = ?",
                (DAYS * ROWS_A_DAY, DAYS * ROWS_A_DAY, BEGIN_US, BEGIN_US + DAYS * DAY_US - 1, key),
            )

        database.submit(write).result()
    server.execute("CREATE TABLE undivided (LIKE chunk INCLUDING STORAGE, PRIMARY KEY (id))")
    server.execute("CREATE INDEX ON undivided (twin, last_us, first_us, n)")
    server.execute("CREATE INDEX ON undivided (twin, last_seq)")
    server.execute("INSERT INTO undivided SELECT * FROM chunk")
    server.execute("VACUUM ANALYZE")


def read_ms(server: Server, parameters: Callable[[int], Sequence[int]], **where: str) -> list[float]:
    """Return the times of the store's own statements, medians of READS each in turn.

    ``where`` holds a condition for each table; ``parameters`` are those for a twin, as many of them as a condition takes.
    """
    took: dict[str, list[float]] = {table: [] for table in where}
    for k in range(READS):
        for table, condition in where.items():
            query = f"SELECT time, value FROM {table} WHERE {condition} ORDER BY first_us, id".replace("?", "%s")
            given = parameters(1 + k % TWINS)[: condition.count("?")]
            begun = time.perf_counter()
            found = server.execute(query, given, binary=True).fetchall()  # type: ignore[arg-type]
            took[table].append(time.perf_counter() - begun)
            assert len(found) == 1
    return [1e3 * float(np.median(times)) for times in took.values()]


def logged(server: Server, action: Callable[[], object]) -> tuple[float, float]:
    """Return how long something takes in seconds, and how much of the database's log it writes in MB."""

    def position() -> int:
        """Return how many bytes have been logged."""
        row = server.execute("SELECT pg_current_wal_insert_lsn() - '0/0'").fetchone()
        return int(str(row[0])) if row is not None else 0

    before, begun = position(), time.perf_counter()
    action()
    return time.perf_counter() - begun, (position() - before) / 1e6


def count(server: Server) -> int:
    """Return how many segments there are."""
    row = server.execute("SELECT count(*) FROM chunk").fetchone()
    return int(str(row[0])) if row else 0


def measure_ingest(url: str, tell: Tell) -> None:
    """Measure small batches of many twins beside plain COPY and merge."""
    for rows, blocks, block in SHAPES:
        with contextlib.ExitStack() as stack:
            made = [side(url, INGEST_TWINS) for side in (through_the_store, one_by_one, copied_and_merged)]
            took = in_turn([stack.enter_context(side) for side in made], INGEST_TWINS, rows, blocks, block)
        ours, alone, copied = rows * blocks * block / took.sum(axis=0)
        tell(
            f"ingest, batches of {rows} × {CHANNELS}",
            f"{ours:,.0f} samples/s; one by one {alone:,.0f}",
            f"COPY and INSERT … SELECT {copied:,.0f}",
            share_of(took, 0, 2),
        )


def measure_reads(server: Server, tell: Tell) -> None:
    """Measure the store's reads beside those of a table that is not divided."""
    plain, newest = "twin = ? AND last_us >= ? AND first_us < ?", "twin = ? AND last_seq > ?"

    def beside(what: str, divided: float, whole: float) -> None:
        """Add a row."""
        tell(what, f"{divided:.2f} ms", f"undivided {whole:.2f} ms", f"{divided / whole:.1f}")

    for what, day in (("newest", DAYS - 1), ("middle", DAYS // 2)):
        start = BEGIN_US + day * DAY_US
        found = read_ms(server, lambda twin, a=start: within(twin, a, a + DAY_US), chunk=WITHIN, undivided=plain)  # type: ignore[misc]
        beside(f"read of the {what} day of {DAYS}", *found)
    found = read_ms(server, lambda twin: (twin, DAYS * ROWS_A_DAY - 1), chunk=newest, undivided=newest)
    beside("read of what came last", *found)


def measure_retention(database: Database, server: Server, tell: Tell) -> None:
    """Measure the dropping of whole quarters beside deleting segments one by one."""
    before = count(server)
    for key in range(1, TWINS // 2 + 1):
        database.submit(retention.put, key, Retention(samples_days=float(KEPT_DAYS))).result()

    def sweep() -> None:
        """Delete what half of the twins keep no longer, while the others keep all."""
        for twin in database.engine.read(retention.due):
            while database.submit(retention.sweep_old, twin).result():
                pass

    deleted = logged(server, sweep)
    vacuumed = logged(server, lambda: server.execute("VACUUM chunk"))
    n = before - count(server)
    database.submit(lambda c: c.execute("UPDATE twin SET retention = '{}'") and None).result()
    server.execute("INSERT INTO chunk SELECT * FROM undivided WHERE id NOT IN (SELECT id FROM chunk)")
    for key in range(1, TWINS + 1):
        database.submit(retention.put, key, Retention(samples_days=float(KEPT_DAYS))).result()
    gone: list[int] = []

    def drop() -> None:
        """Drop what no twin keeps."""
        while found := database.engine.drop_old():
            gone.append(found)

    dropped = logged(server, drop)
    each, quarter = 1e3 * (deleted[0] + vacuumed[0]) / n, 1e3 * dropped[0] / len(gone)
    tell(
        f"retention, {KEPT_DAYS} of {DAYS} days",
        f"{quarter:.0f} ms a quarter of {sum(gone) // len(gone)} segments",
        f"one by one {each:.2f} ms a segment",
        f"{quarter * len(gone) / sum(gone) / each:.2f} a segment",
    )
    logs = [1e3 * dropped[1] / len(gone), 1e3 * (deleted[1] + vacuumed[1]) / n]
    tell("of the database's log for it", f"{logs[0]:.0f} kB a quarter", f"{logs[1]:.1f} kB a segment", "")


def main() -> None:
    """Measure and write the table."""
    rows: list[list[str]] = []

    def tell(*cells: str) -> None:
        """Add a row to the table."""
        rows.append(list(cells))
        print(" | ".join(cells), flush=True)

    with contextlib.ExitStack() as stack:
        url = os.environ.get("TWIN_TEST_POSTGRES_URL") or stack.enter_context(own_server("fsync=on")).url
        measure_ingest(url, tell)
        place = stack.enter_context(fresh_database(url))
        database = Database(place)
        server = stack.enter_context(psycopg.connect(place, autocommit=True))
        fill(database, server)
        measure_reads(server, tell)
        measure_retention(database, server, tell)
        database.close()
    note = (
        f"Ingest: {INGEST_TWINS} twins, blocks of up to {4 * SHARE} batches on each side in turn, the first not counted: "
        "the ratio of all of them, and of a block the median and the quartiles; "
        f"both sides commit as durably, up to {SHARE} batches each. "
        f"Reads and retention: {TWINS * DAYS:,} segments of {ROWS_A_DAY} samples in 16 quarters, by the store's statements. "
        "A quarter is dropped once no twin keeps anything of it, under a lock on the whole table that is given up after a "
        "second; what some twins keep is deleted one by one, beside which ingest goes on, and VACUUM clears up."
    )
    table = markdown_table(["what", "the store", "beside", "ratio"], rows)
    save_table("fleet_store", "How samples are stored", table, "benchmarks.fleet_store", note)


if __name__ == "__main__":
    main()
