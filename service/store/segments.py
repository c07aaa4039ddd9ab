"""Segments: the rows in which samples are stored, whole batches each and never a row per sample.

A segment holds four arrays as little-endian bytes: the stream numbers, the instants and when they were received (n_times,), and
the values (n_channels, n_times). Small ones are rewritten as one from time to time; what they hold never changes. All samples of
a segment are of one quarter, so that a database may keep each quarter by itself; only what earlier releases stored may span
several, and how long that is at most, the twin's ``head.reach_us`` tells.
"""

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from service.store import outline
from service.store.batch import Batch
from service.store.blobs import instants, matrix
from service.store.connection import Connection, Row, Stage
from service.store.quarters import divided, quarter_of, start_us

SMALL = 512
"""Segments with fewer rows than this are compacted."""
MOST_SMALL_CHUNKS = 64
MOST_SMALL_ROWS = 16_384
MOST_CUTS = 16
"""Compaction cuts where a step exceeds this fraction of the whole span, so at most this often."""

WITHIN = """twin = ? AND last_us >= ? AND first_us < ?
            AND first_us >= ? - (SELECT reach_us FROM head WHERE head.twin = ?)"""
"""Which segments may hold samples of a twin with start <= time < stop; the last line says again where to look for them."""


def within(twin: int, start: int, stop: int) -> tuple[int, ...]:
    """Return the parameters of ``WITHIN``; start and stop in microseconds since 1970."""
    return (twin, start, stop, start_us(quarter_of(start)), twin)


_INSERT = """INSERT INTO chunk (twin, n, first_us, last_us, last_seq, seq, time, value, received)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"""


def insert(connection: Connection, twin: int, seq: NDArray[np.int64], batch: Batch) -> None:
    """Store samples, a segment for each quarter; the head of the archive has been moved already."""
    parts = divided(batch.time_us)
    make_room(connection, [int(batch.time_us[part].min()) for part in parts])
    for part in parts:
        _insert(connection, twin, seq[part], batch.take(part))


def make_room(connection: Connection, instants: Iterable[int]) -> None:
    """Let the database have a place for segments that begin at some instants, if it needs to know beforehand."""
    stage: Stage | None = getattr(connection, "stage", None)
    if stage is not None:
        stage.make_room(instants)


def _insert(connection: Connection, twin: int, seq: NDArray[np.int64], batch: Batch) -> None:
    has_outline = batch.time_us.size >= outline.PIECE
    row = connection.execute(
        _INSERT + " RETURNING id" if has_outline else _INSERT,  # to return it costs a tenth of a small batch
        segment(twin, seq, batch),
    )
    if has_outline:
        outline.put(connection, "chunk", int(row.fetchone()[0]), batch.time_us, batch.values)


def segment(twin: int, seq: NDArray[np.int64], batch: Batch) -> Row:
    """Return a batch as a row of the table of chunks."""
    return (
        twin,
        int(batch.time_us.size),
        int(batch.time_us.min()),
        int(batch.time_us.max()),
        int(seq.max()),
        np.ascontiguousarray(seq, dtype="<i8").data,
        np.ascontiguousarray(batch.time_us, dtype="<i8").data,
        np.ascontiguousarray(batch.values, dtype="<f8").data,
        None if batch.received_us is None else np.ascontiguousarray(batch.received_us, dtype="<i8").data,
    )


def unpack(n_rows: int, time: bytes, value: bytes, received: bytes | None) -> Batch:
    """Return what a chunk holds."""
    arrived_us = None if received is None else np.frombuffer(received, dtype="<i8")
    time_us = instants(time)
    return Batch(time_us, matrix(value, n_rows, time_us.size), arrived_us)


def _widened(values: NDArray[np.float64], n_rows: int) -> NDArray[np.float64]:
    """Return values with rows of missing ones for channels that the twin has got since."""
    missing = n_rows - values.shape[0]
    return np.vstack([values, np.full((missing, values.shape[1]), np.nan)]) if missing else values


def joined(batches: Sequence[Batch], n_rows: int) -> Batch:
    """Return batches as one, in their order."""
    times = [np.empty(0, dtype=np.int64), *(batch.time_us for batch in batches)]
    values = [np.empty((n_rows, 0)), *(_widened(batch.values, n_rows) for batch in batches)]
    received = [np.empty(0, dtype=np.int64), *(batch.received for batch in batches)]
    return Batch(np.concatenate(times), np.concatenate(values, axis=1), np.concatenate(received))


def compact(connection: Connection, twin: int, values_rows: int) -> None:
    """Rewrite the small chunks in the order of time, cut where time makes a jump, so that none spans idle years."""
    rows = connection.execute(
        "SELECT id, first_us, seq, time, value, received FROM chunk WHERE twin = ? AND n < ? ORDER BY id", (twin, SMALL)
    ).fetchall()
    seq = np.concatenate([np.frombuffer(row[2], dtype="<i8") for row in rows])
    whole = joined([unpack(values_rows, *row[3:]) for row in rows], values_rows)
    steps = np.diff(whole.time_us)
    if (steps < 0).any():
        order = np.argsort(whole.time_us, kind="stable")
        seq, whole = seq[order], Batch(whole.time_us[order], whole.values[:, order], whole.received[order])
        steps = np.diff(whole.time_us)
    remove(connection, [row[:2] for row in rows])
    time_us = whole.time_us
    cuts = np.flatnonzero(steps > max(int(time_us[-1] - time_us[0]) // MOST_CUTS, 1)) + 1
    for first, stop in pairwise([0, *cuts.tolist(), time_us.size]):
        part = Batch(time_us[first:stop], whole.values[:, first:stop], whole.received[first:stop])
        insert(connection, twin, seq[first:stop], part)
    count_small(connection, twin)


def remove(connection: Connection, segments: Iterable[tuple[int, int]]) -> None:
    """Remove segments by their (id, first instant): the instant tells where the id is to be looked for."""
    connection.executemany("DELETE FROM chunk WHERE id = ? AND first_us = ?", segments)


def count_small(connection: Connection, twin: int) -> None:
    """Note how many small chunks there are, and how many samples they hold."""
    connection.execute(
        """UPDATE head SET (small_chunks, small_rows) =
           (SELECT count(*), coalesce(sum(n), 0) FROM chunk WHERE chunk.twin = head.twin AND n < ?) WHERE twin = ?""",
        (SMALL, twin),
    )
