"""Ingest into PostgreSQL in turn: through the store, and by plain COPY into a stage with one INSERT … SELECT.

Each side takes the same batches, a block of them at a time, so that whatever else the machine does meets both alike.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import psycopg
from numpy.typing import NDArray

from service.store import appending, segments, twins
from service.store.batch import Batch
from service.store.database import Database
from tests.service.postgres import fresh_database

CHANNELS = 12
BEGIN_US = 1_767_225_600_000_000
"""Of the telemetry: 2026-01-01."""
SHARE = 256
"""Batches of a commit, on both sides."""

Work = Sequence[tuple[int, Batch]]
Side = Callable[[Work], float]
"""Stores batches of (twin, batch) durably and returns the seconds that took."""


def specification(name: str) -> dict[str, Any]:
    """Return a twin of a dozen sensors."""
    names = [f"T_{k}" for k in range(CHANNELS)]
    return {
        "twin": name,
        "channels": {channel: {"kind": "temperature", "unit": "K"} for channel in names},
        "nodes": [{"id": f"n{k}", "sensor": channel} for k, channel in enumerate(names)],
    }


def batches(count: int, n_twins: int, rows: int, begin: int = 0) -> list[tuple[int, Batch]]:
    """Return batches of so many samples, in turn for each twin, from the one with number ``begin`` on."""
    generator, made = np.random.default_rng(begin), []
    for number in range(begin, begin + count):
        time_us = BEGIN_US + (number // n_twins * rows + np.arange(rows, dtype=np.int64)) * 1_000_000
        made.append((1 + number % n_twins, Batch(time_us, generator.normal(290, 5, (CHANNELS, rows)), time_us)))
    return made


@contextlib.contextmanager
def through_the_store(server_url: str, n_twins: int) -> Iterator[Side]:
    """Yield the store's side, as the service writes: shared commits, every batch acknowledged."""
    with fresh_database(server_url) as url, contextlib.closing(Database(url)) as database:
        for k in range(n_twins):
            database.submit(twins.register, f"s{k}", specification(f"s{k}")).result()

        def store(work: Work) -> float:
            """Return the seconds from the first batch until the last one is acknowledged; AssertionError if one is refused."""
            done, left, errors = threading.Event(), len(work), list[BaseException]()

            def acknowledge(result: appending.Receipt, error: BaseException | None) -> None:
                """Hear of one batch, in the thread that writes."""
                nonlocal left
                left -= 1
                errors.extend([error] if error is not None else [])
                if not left:
                    done.set()

            begun = time.perf_counter()
            for twin, batch in work:
                database.submit_to(twin, acknowledge, appending.append, twin, batch)
            done.wait()
            elapsed_s = time.perf_counter() - begun
            assert not errors
            return elapsed_s

        yield store


@contextlib.contextmanager
def one_by_one(server_url: str, n_twins: int) -> Iterator[Side]:
    """Yield the store's side, but let it insert every batch by itself, as it does with large ones."""
    with through_the_store(server_url, n_twins) as usual:

        def store(work: Work) -> float:
            """Return the seconds with the stage closed to batches of any size."""
            limit, appending.STAGED_BYTES = appending.STAGED_BYTES, 0
            try:
                return usual(work)
            finally:
                appending.STAGED_BYTES = limit

        yield store


@contextlib.contextmanager
def copied_and_merged(server_url: str, n_twins: int) -> Iterator[Side]:
    """Yield the plain side: COPY into a stage and one INSERT … SELECT, as many batches a commit as the store.

    It does less than the store: heads do not move, numbers are not handed out, only a whole batch is known again, and nothing
    is ever compacted.
    """
    with fresh_database(server_url) as url, contextlib.closing(Database(url)) as database:
        database.submit(segments.make_room, [BEGIN_US]).result()
        with psycopg.connect(url, autocommit=True) as connection:
            connection.execute(
                """CREATE TEMPORARY TABLE stage (twin bigint, n integer, first_us bigint, last_us bigint, last_seq bigint,
                   seq bytea, time bytea, value bytea, received bytea) ON COMMIT DELETE ROWS"""
            )

            def store(work: Work) -> float:
                begun = time.perf_counter()
                for start in range(0, len(work), SHARE):
                    with connection.transaction():
                        _copy(connection, work[start : start + SHARE])
                        connection.execute(
                            """INSERT INTO chunk (twin, n, first_us, last_us, last_seq, seq, time, value, received)
                               SELECT stage.* FROM stage WHERE NOT EXISTS (SELECT 1 FROM chunk AS held
                               WHERE held.twin = stage.twin
                               AND held.first_us = stage.first_us AND held.last_us = stage.last_us)"""
                        )
                return time.perf_counter() - begun

            yield store


def _copy(connection: "psycopg.Connection[Any]", work: Work) -> None:
    """Let the stage hold batches."""
    with connection.cursor().copy("COPY stage FROM STDIN (FORMAT BINARY)") as copy:
        copy.set_types(["int8", "int4", "int8", "int8", "int8", "bytea", "bytea", "bytea", "bytea"])
        for twin, batch in work:
            n = int(batch.time_us.size)
            seq, time_us = np.arange(n, dtype="<i8").tobytes(), batch.time_us.tobytes()
            ends = int(batch.time_us[0]), int(batch.time_us[-1])
            copy.write_row((twin, n, *ends, n, seq, time_us, batch.values.tobytes(), time_us))


def in_turn(sides: Sequence[Side], n_twins: int, rows: int, blocks: int, block: int) -> NDArray[np.float64]:
    """Return the seconds of every block of batches on every side, (blocks, sides); the first block of all is not counted."""
    took = []
    for number in range(blocks + 1):
        work = batches(block, n_twins, rows, number * block)
        order = range(len(sides)) if number % 2 else reversed(range(len(sides)))
        found = {k: sides[k](work) for k in order}
        took.append([found[k] for k in range(len(sides))])
    return np.array(took[1:])


def share_of(took: NDArray[np.float64], ours: int, other: int) -> str:
    """Return how fast one side is beside another in per cent: over all blocks, and the median and quartiles of the blocks."""
    low, median, high = np.quantile(100 * took[:, other] / took[:, ours], (0.25, 0.5, 0.75))
    whole = 100 * took[:, other].sum() / took[:, ours].sum()
    return f"{whole:.0f} %; of a block {median:.0f} ({low:.0f} to {high:.0f})"
