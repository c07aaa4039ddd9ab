"""Samples: append-only chunks of whole batches, never a row per sample.

A chunk holds four arrays as little-endian bytes: the stream numbers, the instants and when they were received (n_times,), and
the values (n_channels, n_times). Small chunks are rewritten as one from time to time; what they hold never changes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from service.store import outline
from service.store.batch import Batch
from service.store.blobs import instants, matrix
from service.store.connection import Connection, Head, Row, Stage
from service.store.errors import TwinGone
from service.store.merge import ACCEPTED, CONFLICT, QUARANTINED, collapse, merge

SMALL = 512
"""Chunks with fewer rows than this are compacted."""
MOST_SMALL_CHUNKS = 64
MOST_SMALL_ROWS = 16_384
MOST_CUTS = 16
"""Compaction cuts where a step exceeds this fraction of the whole span, so at most this often."""
STAGED_BYTES = 1900
"""What is larger does not fit a row of PostgreSQL and is written out of line, on its way through a stage twice."""


@dataclass(frozen=True)
class Receipt:
    """What became of a batch: (n_times,) status, the number of the first stored sample, the archive's last instant.

    ``moved`` is how many samples that were stored before had to go into quarantine because of it.
    """

    status: NDArray[np.int8]
    first_seq: int
    last_us: int | None
    moved: int = 0

    @property
    def stored(self) -> NDArray[np.bool_]:
        """Which samples were stored."""
        return self.status == ACCEPTED

    @cached_property
    def counts(self) -> list[int]:
        """How many samples have each status."""
        counts: list[int] = np.bincount(self.status, minlength=QUARANTINED + 1).tolist()
        return counts

    @property
    def quarantined(self) -> list[int]:
        """Where the samples stand that lie ahead of the present."""
        quarantined: list[int] = np.flatnonzero(self.status == QUARANTINED).tolist()
        return quarantined

    @property
    def conflicts(self) -> list[int]:
        """Where the samples stand that contradict the archive."""
        conflicts: list[int] = np.flatnonzero(self.status == CONFLICT).tolist()
        return conflicts


@dataclass(frozen=True)
class Samples:
    """Samples in the order of time: (n_times,) instants, (n_channels, n_times) values with NaN where missing."""

    time_us: NDArray[np.int64]
    values: NDArray[np.float64]


def append(connection: Connection, twin: int, batch: Batch) -> Receipt:
    """Store what is new in a batch."""
    time_us = batch.time_us
    if time_us.size and bool((time_us[1:] > time_us[:-1]).all()):
        stage: Stage | None = getattr(connection, "stage", None)
        if stage is not None and 8 * (batch.values.size + 3 * time_us.size) < STAGED_BYTES:
            known = stage.head(twin)
            if known is not None and (known.last_us is None or known.last_us < time_us[0]):
                return _put(connection, stage, known, twin, batch)
        head = _advance(connection, twin, batch, int(time_us.size), after_all=True)
        if head is not None:
            _write(connection, twin, batch, head)
            return Receipt(np.zeros(time_us.size, dtype=np.int8), head[0] - int(time_us.size) + 1, int(time_us[-1]))
    return _merge_in(connection, twin, batch)


def _put(connection: Connection, stage: Stage, head: Head, twin: int, batch: Batch) -> Receipt:
    """Store a small batch that comes after everything that is stored, together with those of other twins."""
    n, first_seq, last_us = int(batch.time_us.size), head.seq + 1, int(batch.time_us[-1])
    head.seq, head.last_us = head.seq + n, last_us
    head.small_chunks, head.small_rows = head.small_chunks + 1, head.small_rows + n
    stage.put(_segment(twin, np.arange(first_seq, first_seq + n), batch))
    if head.small_chunks >= MOST_SMALL_CHUNKS or head.small_rows >= MOST_SMALL_ROWS:
        _compact(connection, twin, values_rows=batch.values.shape[0])
    return Receipt(np.zeros(n, dtype=np.int8), first_seq, last_us)


def _merge_in(connection: Connection, twin: int, batch: Batch) -> Receipt:
    """Store what is new in a batch that is late, unordered or empty."""
    row = connection.execute("SELECT seq, last_us FROM head WHERE twin = ?", (twin,)).fetchone()
    if row is None:
        raise TwinGone(f"twin {twin} is gone")
    if batch.time_us.size == 0:
        return Receipt(np.empty(0, dtype=np.int8), row[0] + 1, row[1])
    fate = merge(*_around(connection, twin, batch), batch.time_us, batch.values)
    kept = fate.status == ACCEPTED
    if not kept.any():
        return Receipt(fate.status, row[0] + 1, row[1])
    stored = batch.take(kept)
    head = _advance(connection, twin, stored, fate.n_instants, after_all=False)
    if head is None:
        raise TwinGone(f"twin {twin} is gone")
    _write(connection, twin, stored, head)
    return Receipt(fate.status, row[0] + 1, max(int(stored.time_us.max()), row[1] or 0))


def _advance(
    connection: Connection, twin: int, batch: Batch, n_instants: int, *, after_all: bool
) -> tuple[int, int, int] | None:
    """Move the head of the archive and return its number, small chunks and small rows.

    With ``after_all`` only if the whole batch comes after everything that is stored; None if not.
    """
    n = int(batch.time_us.size)
    first_us, last_us = int(batch.time_us.min()), int(batch.time_us.max())
    small = n < SMALL
    row: tuple[int, int, int] | None = connection.execute(
        """UPDATE head SET seq = seq + ?, samples = samples + ?,
           first_us = CASE WHEN first_us < ? THEN first_us ELSE ? END,
           last_us = CASE WHEN last_us > ? THEN last_us ELSE ? END,
           small_chunks = small_chunks + ?, small_rows = small_rows + ?
           WHERE twin = ? AND (last_us IS NULL OR last_us < ?) RETURNING seq, small_chunks, small_rows""",
        (
            *(n, n_instants, first_us, first_us, last_us, last_us, int(small), n if small else 0, twin),
            first_us if after_all else 2**62,
        ),
    ).fetchone()
    return row


def _write(connection: Connection, twin: int, batch: Batch, head: tuple[int, int, int]) -> None:
    """Write one chunk whose last sample has the head's number, and compact if there are many small ones."""
    seq, small_chunks, small_rows = head
    n = int(batch.time_us.size)
    insert(connection, twin, np.arange(seq - n + 1, seq + 1), batch)
    if small_chunks >= MOST_SMALL_CHUNKS or small_rows >= MOST_SMALL_ROWS:
        _compact(connection, twin, values_rows=batch.values.shape[0])


_INSERT = """INSERT INTO chunk (twin, n, first_us, last_us, last_seq, seq, time, value, received)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"""


def insert(connection: Connection, twin: int, seq: NDArray[np.int64], batch: Batch) -> None:
    """Store a chunk as it is; the head of the archive has been moved already."""
    has_outline = batch.time_us.size >= outline.PIECE
    row = connection.execute(
        _INSERT + " RETURNING id" if has_outline else _INSERT,  # to return it costs a tenth of a small batch
        _segment(twin, seq, batch),
    )
    if has_outline:
        outline.put(connection, "chunk", int(row.fetchone()[0]), batch.time_us, batch.values)


def _segment(twin: int, seq: NDArray[np.int64], batch: Batch) -> Row:
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


def _compact(connection: Connection, twin: int, values_rows: int) -> None:
    """Rewrite the small chunks in the order of time, cut where time makes a jump, so that none spans idle years."""
    rows = connection.execute(
        "SELECT id, seq, time, value, received FROM chunk WHERE twin = ? AND n < ? ORDER BY id", (twin, SMALL)
    ).fetchall()
    seq = np.concatenate([np.frombuffer(row[1], dtype="<i8") for row in rows])
    whole = joined([unpack(values_rows, *row[2:]) for row in rows], values_rows)
    steps = np.diff(whole.time_us)
    if (steps < 0).any():
        order = np.argsort(whole.time_us, kind="stable")
        seq, whole = seq[order], Batch(whole.time_us[order], whole.values[:, order], whole.received[order])
        steps = np.diff(whole.time_us)
    connection.executemany("DELETE FROM chunk WHERE id = ?", [(row[0],) for row in rows])
    time_us = whole.time_us
    cuts = np.flatnonzero(steps > max(int(time_us[-1] - time_us[0]) // MOST_CUTS, 1)) + 1
    for first, stop in pairwise([0, *cuts.tolist(), time_us.size]):
        part = Batch(time_us[first:stop], whole.values[:, first:stop], whole.received[first:stop])
        insert(connection, twin, seq[first:stop], part)
    count_small(connection, twin)


def count_small(connection: Connection, twin: int) -> None:
    """Note how many small chunks there are, and how many samples they hold."""
    connection.execute(
        """UPDATE head SET (small_chunks, small_rows) =
           (SELECT count(*), coalesce(sum(n), 0) FROM chunk WHERE chunk.twin = head.twin AND n < ?) WHERE twin = ?""",
        (SMALL, twin),
    )


def _around(connection: Connection, twin: int, batch: Batch) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return what the archive holds at the instants of a batch, reading only the chunks that can hold any of them."""
    instants, n_rows = np.unique(batch.time_us), batch.values.shape[0]
    spans = np.array(
        connection.execute(
            "SELECT id, first_us, last_us FROM chunk WHERE twin = ? AND last_us >= ? AND first_us <= ?",
            (twin, int(instants[0]), int(instants[-1])),
        ).fetchall(),
        dtype=np.int64,
    ).reshape(-1, 3)
    hit = np.searchsorted(instants, spans[:, 1]) < np.searchsorted(instants, spans[:, 2], side="right")
    if not hit.any():
        return np.empty(0, dtype=np.int64), np.empty((n_rows, 0))
    ids = ",".join(map(str, spans[hit, 0].tolist()))
    chunks = connection.execute(f"SELECT id, time FROM chunk WHERE id IN ({ids})").fetchall()
    stored = [np.frombuffer(time, dtype="<i8") for _, time in chunks]
    times, values = [np.empty(0, dtype=np.int64)], [np.empty((n_rows, 0))]
    for (chunk, _), time_us, wanted in zip(chunks, stored, _found_in(stored, instants), strict=True):
        if wanted.any():
            value = connection.execute("SELECT value FROM chunk WHERE id = ?", (chunk,)).fetchone()[0]
            times.append(time_us[wanted])
            values.append(matrix(value, n_rows, wanted.size)[:, wanted])
    time_us, known = np.concatenate(times), np.concatenate(values, axis=1)
    return collapse(time_us, known) if time_us.size else (time_us, known)


def _found_in(stored: list[NDArray[np.int64]], instants: NDArray[np.int64]) -> list[NDArray[np.bool_]]:
    """Return for each array which of its elements are among some instants, which increase; all arrays at once."""
    if not stored:
        return []
    joined = np.concatenate(stored)
    place = np.searchsorted(instants, joined)
    found = instants[np.minimum(place, instants.size - 1)] == joined
    if not found.any():
        return [np.zeros(0, dtype=np.bool_)] * len(stored)
    return np.split(found, np.cumsum([time_us.size for time_us in stored[:-1]]))


def select(
    connection: Connection,
    twin: int,
    n_channels: int,
    rows: Sequence[int],
    start_us: int | None = None,
    stop_us: int | None = None,
) -> Samples:
    """Return the samples with start <= time < stop, of the channels whose positions ``rows`` names."""
    start = start_us if start_us is not None else -(2**62)
    stop = stop_us if stop_us is not None else 2**62
    chosen = list(rows)
    times, values = [np.empty(0, dtype=np.int64)], [np.empty((len(chosen), 0))]
    query = "SELECT time, value FROM chunk WHERE twin = ? AND last_us >= ? AND first_us < ? ORDER BY first_us, id"
    for time, value in connection.execute(query, (twin, start, stop)):
        time_us = instants(time)
        held = matrix(value, n_channels, time_us.size)[chosen]
        inside = (time_us >= start) & (time_us < stop)
        whole = bool(inside.all())
        times.append(time_us if whole else time_us[inside])
        values.append(held if whole else held[:, inside])
    time_us, found = np.concatenate(times), np.concatenate(values, axis=1)
    return Samples(*collapse(time_us, found)) if time_us.size else Samples(time_us, found)


def overview(
    connection: Connection,
    twin: int,
    n_channels: int,
    rows: Sequence[int],
    start_us: int | None,
    stop_us: int | None,
    max_points: int,
) -> tuple[Samples, int]:
    """Return samples among which are the extremes of start <= time < stop, and how many there are in all.

    Everything is returned where the outlines would hold fewer than ``max_points`` samples.
    """
    start = start_us if start_us is not None else -(2**62)
    stop = stop_us if stop_us is not None else 2**62
    query = (
        "SELECT id, first_us, last_us, n FROM chunk WHERE twin = ? AND last_us >= ? AND first_us < ? ORDER BY first_us"
    )
    spans = connection.execute(query, (twin, start, stop)).fetchall()
    if sum(span[3] for span in spans) // outline.PIECE * 2 * n_channels < max_points:
        found = select(connection, twin, n_channels, rows, start_us, stop_us)
        return found, int(found.time_us.size)
    chosen = list(rows)
    times, values = [np.empty(0, dtype=np.int64)], [np.empty((len(chosen), 0))]
    left_out = 0
    for part in outline.parts(connection, "chunk", [span[:3] for span in spans], start, stop, n_channels):
        time_us, held = part.time_us, part.values
        if time_us is None or held is None:
            time, value = connection.execute("SELECT time, value FROM chunk WHERE id = ?", (part.chunk,)).fetchone()
            time_us = instants(time)
            held = matrix(value, n_channels, time_us.size)
        else:
            left_out += part.instants - time_us.size
        inside = (time_us >= start) & (time_us < stop)
        times.append(time_us[inside])
        values.append(held[chosen][:, inside])
    found = Samples(*collapse(np.concatenate(times), np.concatenate(values, axis=1)))
    return found, int(found.time_us.size) + left_out


def latest_seq(connection: Connection, twin: int) -> int:
    """Return the last number of a twin's stream: every sample of a smaller one is in the archive."""
    row = connection.execute("SELECT seq FROM head WHERE twin = ?", (twin,)).fetchone()
    if row is None:
        raise TwinGone(f"twin {twin} is gone")
    return int(row[0])


def revision(connection: Connection, twin: int) -> int:
    """Return how often stored samples of a twin were taken away."""
    row = connection.execute("SELECT revision FROM head WHERE twin = ?", (twin,)).fetchone()
    if row is None:
        raise TwinGone(f"twin {twin} is gone")
    return int(row[0])


def arrived(connection: Connection, twin: int, after_seq: int, start_us: int, stop_us: int) -> NDArray[np.int64]:
    """Return the instants, start <= time < stop, of samples that came after one stream number, in any order."""
    found = [np.empty(0, dtype=np.int64)]
    query = "SELECT seq, time FROM chunk WHERE twin = ? AND last_seq > ? AND last_us >= ? AND first_us < ?"
    for seq, time in connection.execute(query, (twin, after_seq, start_us, stop_us)):
        instants = np.frombuffer(time, dtype="<i8")[np.frombuffer(seq, dtype="<i8") > after_seq]
        found.append(instants[(instants >= start_us) & (instants < stop_us)])
    return np.concatenate(found)


def since_seq(connection: Connection, twin: int, n_channels: int, after_seq: int) -> tuple[NDArray[np.int64], Samples]:
    """Return stream numbers and samples after one number, in the order of arrival."""
    seqs, times, values = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [np.empty((n_channels, 0))]
    query = "SELECT seq, time, value FROM chunk WHERE twin = ? AND last_seq > ?"
    for seq, time, value in connection.execute(query, (twin, after_seq)):
        numbers = np.frombuffer(seq, dtype="<i8")
        new = numbers > after_seq
        seqs.append(numbers[new])
        times.append(np.frombuffer(time, dtype="<i8")[new])
        values.append(matrix(value, n_channels, new.size)[:, new])
    numbers = np.concatenate(seqs)
    order = np.argsort(numbers)
    return numbers[order], Samples(np.concatenate(times)[order], np.concatenate(values, axis=1)[:, order])


def block_stop(connection: Connection, twin: int, start_us: int | None, n_rows: int) -> int | None:
    """Return an instant before which about ``n_rows`` samples lie, counted from ``start_us``; None if fewer are left."""
    query = "SELECT last_us, n FROM chunk WHERE twin = ? AND last_us > ? ORDER BY last_us"
    total = 0
    for last_us, n in connection.execute(query, (twin, -(2**62) if start_us is None else start_us)):
        total += n
        if total >= n_rows:
            return int(last_us) + 1
    return None


def count_after(connection: Connection, twin: int, after_us: int | None) -> int:
    """Return how many samples lie behind an instant; those that came in pieces count as often."""
    after = -(2**62) if after_us is None else after_us
    query = "SELECT coalesce(sum(n), 0) FROM chunk WHERE twin = ? AND last_us > ? AND first_us > ?"
    count = int(connection.execute(query, (twin, after, after)).fetchone()[0])
    query = "SELECT time FROM chunk WHERE twin = ? AND last_us > ? AND first_us <= ?"
    for (time,) in connection.execute(query, (twin, after, after)):
        count += int((np.frombuffer(time, dtype="<i8") > after).sum())
    return count


def nth_newest_us(connection: Connection, twin: int, count: int) -> int | None:
    """Return the instant from which on about ``count`` samples lie; None if there are no more than that."""
    found = 0
    query = "SELECT first_us, last_us, n FROM chunk WHERE twin = ? ORDER BY last_us DESC"
    rows = iter(connection.execute(query, (twin,)))
    for first_us, _, n in rows:
        found += n
        if found >= count:
            return int(first_us) if next(rows, None) is not None else None
    return None


def newest(connection: Connection, twin: int, n_channels: int, count: int) -> Samples:
    """Return the last ``count`` samples of the archive, or all if there are fewer."""
    found, start_us = 0, -(2**62)
    query = "SELECT first_us, n FROM chunk WHERE twin = ? ORDER BY last_us DESC"
    for first_us, n in connection.execute(query, (twin,)):
        found, start_us = found + n, first_us if found == 0 else min(start_us, first_us)
        if found >= 2 * count:  # chunks may overlap: one that began earlier may end later
            break
    else:
        start_us = -(2**62)
    held = select(connection, twin, n_channels, range(n_channels), start_us)
    return Samples(held.time_us[-count:], held.values[:, -count:])


def newest_first(connection: Connection, twin: int, n_channels: int, after_seq: int) -> Iterator[Batch]:
    """Yield the chunks with samples that came after a stream number, those that end latest first."""
    query = """SELECT time, value, received FROM chunk WHERE twin = ? AND last_seq > ? ORDER BY last_us DESC"""
    for blobs in connection.execute(query, (twin, after_seq)):
        yield unpack(n_channels, *blobs)


MOST_SEARCHED = 256
"""Chunks, some millions of samples, that are searched for the last value of a channel."""


def last_values(
    connection: Connection, twin: int, n_channels: int, rows: Sequence[int], before_us: int
) -> dict[int, float]:
    """Return the last value before an instant of each channel whose position ``rows`` names; absent where none is found."""
    found: dict[int, tuple[int, float]] = {}
    query = """SELECT last_us, time, value FROM chunk WHERE twin = ? AND first_us < ?
               ORDER BY last_us DESC LIMIT ?"""
    for last_us, time, value in connection.execute(query, (twin, before_us, MOST_SEARCHED)):
        if len(found) == len(rows) and last_us < min(instant for instant, _ in found.values()):
            break
        time_us = instants(time)
        held = matrix(value, n_channels, time_us.size)
        for row in rows:
            at = np.flatnonzero((time_us < before_us) & np.isfinite(held[row]))
            if at.size:
                best = at[np.argmax(time_us[at])]
                found[row] = max(found.get(row, (-(2**62), 0.0)), (int(time_us[best]), float(held[row, best])))
    return {row: value for row, (_, value) in found.items()}
