"""Appending batches to the archive: what comes after everything goes in as it is, anything else is merged first."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from service.store import segments
from service.store.batch import Batch
from service.store.blobs import matrix
from service.store.connection import Connection, Head, Stage
from service.store.errors import TwinGone
from service.store.merge import ACCEPTED, CONFLICT, QUARANTINED, Merge, collapse, merge
from service.store.quarters import divided, quarter_of
from service.store.segments import MOST_SMALL_CHUNKS, MOST_SMALL_ROWS, SMALL, WITHIN, within

STAGED_BYTES = 1900
"""What is larger does not fit a row of PostgreSQL and is written out of line, on its way through a stage twice."""

MOST_STAGED_CHUNKS = 256
"""Where batches share a commit, small segments are compacted once there are so many: rewriting them costs more than taking them
in, and to read so many takes a millisecond."""


@dataclass(frozen=True)
class Receipt:
    """What became of a batch: (n_times,) status, the number of the first stored sample, the archive's last instant.

    ``moved`` is how many samples that were stored before had to go into quarantine because of it; ``is_crowded`` tells that
    small segments wait to be compacted.
    """

    status: NDArray[np.int8]
    first_seq: int
    last_us: int | None
    moved: int = 0
    is_crowded: bool = False

    @property
    def stored(self) -> NDArray[np.bool_]:
        """Which samples were stored."""
        return self.status == ACCEPTED

    @cached_property
    def counts(self) -> list[int]:
        """How many samples have each status."""
        if not self.status.any():
            return [self.status.size, 0, 0, 0]
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


def append(connection: Connection, twin: int, batch: Batch, *, compacts: bool = True) -> Receipt:
    """Store what is new in a batch; where small segments become many, they are compacted, or the receipt says so."""
    time_us = batch.time_us
    n = time_us.size
    if n == 1 or (n and bool((time_us[1:] > time_us[:-1]).all())):
        stage: Stage | None = getattr(connection, "stage", None)
        if stage is not None and 8 * (batch.values.size + 3 * n) < STAGED_BYTES:
            known = stage.head(twin)
            first_us = int(time_us[0])
            if known is not None and (known.last_us is None or known.last_us < first_us):
                return _put(stage, known, twin, batch, first_us)
        ends = (int(time_us[0]), int(time_us[-1]))
        head = _advance(connection, twin, batch, n, ends, after_all=True)
        if head is not None:
            is_crowded = _write(connection, twin, batch, head, ends, compacts=compacts)
            status = np.zeros(n, dtype=np.int8)
            return Receipt(status, head[0] - n + 1, int(time_us[-1]), is_crowded=is_crowded)
    return _merge_in(connection, twin, batch, compacts=compacts)


def _put(stage: Stage, head: Head, twin: int, batch: Batch, first_us: int) -> Receipt:
    """Store a small batch that comes after everything that is stored, together with those of other twins."""
    n, first_seq = batch.time_us.size, head.seq + 1
    last_us = first_us if n == 1 else int(batch.time_us[-1])
    head.seq, head.last_us, head.small_rows = head.seq + n, last_us, head.small_rows + n
    seq = np.arange(first_seq, head.seq + 1)
    if n == 1 or quarter_of(first_us) == quarter_of(last_us):
        stage.put(segments.packed(twin, (first_us, last_us, head.seq), seq, batch))
        head.small_chunks += 1
    else:
        for part in divided(batch.time_us):
            stage.put(segments.segment(twin, seq[part], batch.take(part)))
            head.small_chunks += 1
    if head.small_chunks >= MOST_STAGED_CHUNKS or head.small_rows >= MOST_SMALL_ROWS:
        stage.compact_later(twin, batch.values.shape[0])
    return Receipt(np.zeros(n, dtype=np.int8), first_seq, last_us)


def _merge_in(connection: Connection, twin: int, batch: Batch, *, compacts: bool) -> Receipt:
    """Store what is new in a batch that is late, unordered or empty."""
    row = connection.execute("SELECT seq, last_us FROM head WHERE twin = ?", (twin,)).fetchone()
    if row is None:
        raise TwinGone(f"twin {twin} is gone")
    if batch.time_us.size == 0:
        return Receipt(np.empty(0, dtype=np.int8), row[0] + 1, row[1])
    instants = np.unique(batch.time_us)
    known = _around(connection, twin, batch, instants)
    if known[0].size == 0 and instants.size == batch.time_us.size:  # nothing to be compared with
        fate, stored = Merge(np.zeros(instants.size, dtype=np.int8), instants.size), batch
        ends = (int(instants[0]), int(instants[-1]))
    else:
        fate = merge(*known, batch.time_us, batch.values)
        kept = fate.status == ACCEPTED
        if not kept.any():
            return Receipt(fate.status, row[0] + 1, row[1])
        stored = batch.take(kept)
        ends = (int(stored.time_us.min()), int(stored.time_us.max()))
    head = _advance(connection, twin, stored, fate.n_instants, ends, after_all=False)
    if head is None:
        raise TwinGone(f"twin {twin} is gone")
    is_crowded = _write(connection, twin, stored, head, ends, compacts=compacts)
    return Receipt(fate.status, row[0] + 1, max(ends[1], row[1] or 0), is_crowded=is_crowded)


def _advance(
    connection: Connection, twin: int, batch: Batch, n_instants: int, ends: tuple[int, int], *, after_all: bool
) -> tuple[int, int, int] | None:
    """Move the head of the archive and return its number, small chunks and small rows; ``ends`` are the first and last instant.

    With ``after_all`` only if the whole batch comes after everything that is stored; None if not.
    """
    n = int(batch.time_us.size)
    first_us, last_us = ends
    whole = quarter_of(first_us) == quarter_of(last_us)
    sizes = [n] if whole else [batch.time_us[part].size for part in divided(batch.time_us)]
    small = [size for size in sizes if size < SMALL]
    row: tuple[int, int, int] | None = connection.execute(
        """UPDATE head SET seq = seq + ?, samples = samples + ?,
           first_us = CASE WHEN first_us < ? THEN first_us ELSE ? END,
           last_us = CASE WHEN last_us > ? THEN last_us ELSE ? END,
           small_chunks = small_chunks + ?, small_rows = small_rows + ?
           WHERE twin = ? AND (last_us IS NULL OR last_us < ?) RETURNING seq, small_chunks, small_rows""",
        (
            *(n, n_instants, first_us, first_us, last_us, last_us, len(small), sum(small), twin),
            first_us if after_all else 2**62,
        ),
    ).fetchone()
    return row


def _write(
    connection: Connection,
    twin: int,
    batch: Batch,
    head: tuple[int, int, int],
    ends: tuple[int, int],
    *,
    compacts: bool,
) -> bool:
    """Write one chunk whose last sample has the head's number; return whether there are many small ones, not compacted."""
    seq, small_chunks, small_rows = head
    n = int(batch.time_us.size)
    segments.insert(connection, twin, np.arange(seq - n + 1, seq + 1), batch, ends)
    is_crowded = small_chunks >= MOST_SMALL_CHUNKS or small_rows >= MOST_SMALL_ROWS
    if is_crowded and compacts:
        segments.compact(connection, {twin: batch.values.shape[0]})
    return is_crowded and not compacts


def _around(
    connection: Connection, twin: int, batch: Batch, instants: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return what the archive holds at the instants of a batch, in order, reading only the chunks that can hold any of them."""
    n_rows = batch.values.shape[0]
    query = f"SELECT id, first_us, last_us FROM chunk WHERE {WITHIN}"
    overlapping = connection.execute(query, within(twin, int(instants[0]), int(instants[-1]) + 1)).fetchall()
    spans = np.array(overlapping, dtype=np.int64).reshape(-1, 3)
    hit = np.searchsorted(instants, spans[:, 1]) < np.searchsorted(instants, spans[:, 2], side="right")
    if not hit.any():
        return np.empty(0, dtype=np.int64), np.empty((n_rows, 0))
    ids = ",".join(map(str, spans[hit, 0].tolist()))
    query = f"SELECT id, first_us, time FROM chunk WHERE id IN ({ids}) AND first_us >= ? AND first_us <= ?"
    chunks = connection.execute(query, (int(spans[hit, 1].min()), int(spans[hit, 1].max()))).fetchall()
    stored = [np.frombuffer(time, dtype="<i8") for _, _, time in chunks]
    times, values = [np.empty(0, dtype=np.int64)], [np.empty((n_rows, 0))]
    for (*place, _), time_us, wanted in zip(chunks, stored, _found_in(stored, instants), strict=True):
        if wanted.any():
            (value,) = connection.execute("SELECT value FROM chunk WHERE id = ? AND first_us = ?", place).fetchone()
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
