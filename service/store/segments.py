"""Segments: the rows in which samples are stored, whole batches each and never a row per sample.

A segment holds four arrays as little-endian bytes: the stream numbers, the instants and when they were received (n_times,), and
the values (n_channels, n_times). Small ones are rewritten as one from time to time; what they hold never changes. All samples of
a segment are of one quarter, so that a database may keep each quarter by itself; only what earlier releases stored may span
several, and how long that is at most, the twin's ``head.reach_us`` tells.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.store import outline
from service.store.batch import Batch
from service.store.blobs import instants, matrix, side_by_side
from service.store.connection import Connection, Cursor, Row, Stage
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


_WHOLE, _REAL = np.dtype("<i8"), np.dtype("<f8")
_INSERT = """INSERT INTO chunk (twin, n, first_us, last_us, last_seq, seq, time, value, received)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"""


def insert(
    connection: Connection, twin: int, seq: NDArray[np.int64], batch: Batch, ends: tuple[int, int] | None = None
) -> None:
    """Store samples, a segment for each quarter; the head of the archive has been moved already.

    ``ends``, where they are known, are the first and last instant; ``seq`` increases then.
    """
    if ends is not None and quarter_of(ends[0]) == quarter_of(ends[1]):
        make_room(connection, [ends[0]])
        query = _INSERT + " RETURNING id" if batch.time_us.size >= outline.PIECE else _INSERT
        answer = connection.execute(query, packed(twin, (*ends, int(seq[-1])), seq, batch))
        _outline(connection, [(batch, answer)])
    else:
        _outline(connection, _insert(connection, twin, seq, batch))


def make_room(connection: Connection, instants: Iterable[int]) -> None:
    """Let the database have a place for segments that begin at some instants, if it needs to know beforehand."""
    stage: Stage | None = getattr(connection, "stage", None)
    if stage is not None:
        stage.make_room(instants)


Stored = list[tuple[Batch, Cursor]]
"""Segments, and what the database answers to each of them: its id, where an outline needs that."""


def _insert(connection: Connection, twin: int, seq: NDArray[np.int64], batch: Batch) -> Stored:
    """Send samples, a segment for each quarter, without waiting for the answers."""
    parts = divided(batch.time_us)
    make_room(connection, [int(batch.time_us[part].min()) for part in parts])
    stored = []
    for part in parts:
        held = batch.take(part)
        query = _INSERT + " RETURNING id" if held.time_us.size >= outline.PIECE else _INSERT  # a tenth of a small batch
        stored.append((held, connection.execute(query, segment(twin, seq[part], held))))
    return stored


def _outline(connection: Connection, stored: Stored) -> None:
    """Store the outlines of large segments."""
    for batch, answer in stored:
        if batch.time_us.size >= outline.PIECE:
            outline.put(connection, "chunk", int(answer.fetchone()[0]), batch.time_us, batch.values)


def segment(twin: int, seq: NDArray[np.int64], batch: Batch) -> Row:
    """Return a batch as a row of the table of chunks."""
    ends = (int(batch.time_us.min()), int(batch.time_us.max()), int(seq.max()))
    return packed(twin, ends, seq, batch)


def packed(twin: int, ends: tuple[int, int, int], seq: NDArray[np.int64], batch: Batch) -> Row:
    """The same where (first instant, last instant, last number) are known: to look for them is half of a small batch's cost."""
    return (
        twin,
        batch.time_us.size,
        *ends,
        _bytes(seq, _WHOLE),
        _bytes(batch.time_us, _WHOLE),
        _bytes(batch.values, _REAL),
        None if batch.received_us is None else _bytes(batch.received_us, _WHOLE),
    )


def _bytes(array: NDArray[np.int64] | NDArray[np.float64], kind: "np.dtype[Any]") -> bytes:
    """Return an array as it is stored; to ask for a conversion where none is needed is a tenth of a small batch's cost."""
    return array.tobytes() if array.dtype is kind else array.astype(kind).tobytes()


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


def compact(connection: Connection, n_rows: Mapping[int, int]) -> None:
    """Rewrite the small segments of twins in the order of time, cut where time makes a jump, so that none spans idle years.

    Parameters
    ----------
    n_rows
        Twin -> rows of its values.
    """
    gone = connection.execute(
        f"""DELETE FROM chunk WHERE twin IN ({", ".join(map(str, n_rows))}) AND n < ?
            RETURNING twin, id, seq, time, value, received""",
        (SMALL,),
    ).fetchall()
    held: dict[int, list[Row]] = {twin: [] for twin in n_rows}
    for row in sorted(gone, key=itemgetter(1)):
        held[row[0]].append(row)
    counts, stored = [], Stored()
    for twin, rows in held.items():
        made = _rewrite(connection, twin, rows, n_rows[twin]) if rows else []
        sizes = [size for batch, _ in made if (size := batch.time_us.size) < SMALL]
        counts.append((len(sizes), sum(sizes), twin))
        stored += made
    _outline(connection, stored)
    connection.executemany("UPDATE head SET small_chunks = ?, small_rows = ? WHERE twin = ?", counts)


def _rewrite(connection: Connection, twin: int, rows: Sequence[Row], n_rows: int) -> Stored:
    """Send what segments (twin, id, seq, time, value, received) of a twin held in as few as may be."""
    _, _, numbers, times, values, arrived = zip(*rows, strict=True)
    seq, time_us = instants(b"".join(numbers)), instants(b"".join(times))
    received = [bytes(len(time)) if blob is None else blob for time, blob in zip(times, arrived, strict=True)]
    held = side_by_side(values, n_rows, [len(time) // 8 for time in times])
    whole = Batch(time_us, held, instants(b"".join(received)))
    steps = np.diff(whole.time_us)
    if (steps < 0).any():
        order = np.argsort(whole.time_us, kind="stable")
        seq, whole = seq[order], Batch(whole.time_us[order], whole.values[:, order], whole.received[order])
        steps = np.diff(whole.time_us)
    time_us, stored = whole.time_us, Stored()
    cuts = np.flatnonzero(steps > max(int(time_us[-1] - time_us[0]) // MOST_CUTS, 1)) + 1
    for first, stop in pairwise([0, *cuts.tolist(), time_us.size]):
        stored += _insert(connection, twin, seq[first:stop], whole.take(slice(first, stop)))
    return stored


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
