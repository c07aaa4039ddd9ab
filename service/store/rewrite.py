"""Taking samples out of the archive: the one thing that changes what a chunk holds."""

from collections.abc import Sequence

import numpy as np

from service.store import alarms, residuals, segments
from service.store.batch import Batch
from service.store.connection import Connection
from service.store.segments import WITHIN, within


def take_out(
    connection: Connection, twin: int, n_channels: int, start_us: int, stop_us: int, rows: Sequence[int] | None
) -> Batch:
    """Take the samples with start <= time < stop out of the archive and return them, with NaN for what stays.

    Checkpoints that knew of them, and residuals and anomalies there, are forgotten; ``head.revision`` grows by one.

    Parameters
    ----------
    n_channels
        Of the twin.
    rows
        Positions of the channels that lose their values, while the samples stay; None: whole samples go.
    """
    query = f"SELECT id, first_us, seq, time, value, received FROM chunk WHERE {WITHIN} ORDER BY first_us, id"
    taken = []
    for chunk, first_us, seq_blob, *blobs in connection.execute(query, within(twin, start_us, stop_us)).fetchall():
        seq, held = np.frombuffer(seq_blob, dtype="<i8"), segments.unpack(n_channels, *blobs)
        inside = (held.time_us >= start_us) & (held.time_us < stop_us)
        if rows is None:
            taken.append(held.take(inside))
            left, kept = held.take(~inside), seq[~inside]
        else:
            values = np.full_like(held.values, np.nan)
            values[rows] = np.where(inside, held.values[rows], np.nan)
            some = np.isfinite(values).any(axis=0)
            if not some.any():
                continue
            taken.append(Batch(held.time_us[some], values[:, some], held.received[some]))
            left = Batch(held.time_us, np.where(np.isfinite(values), np.nan, held.values), held.received_us)
            kept = seq
        segments.remove(connection, [(chunk, first_us)])
        if kept.size:
            segments.insert(connection, twin, kept, left)
    found = segments.joined(taken, n_channels)
    if found.time_us.size:
        _move_head(connection, twin, int(np.unique(found.time_us).size) if rows is None else 0)
        _forget(connection, twin, start_us, stop_us)
    return found


def _move_head(connection: Connection, twin: int, n_instants: int) -> None:
    """Let the head of the archive say what is left of it."""
    connection.execute(
        """UPDATE head SET revision = revision + 1, samples = samples - ?,
           (first_us, last_us) = (SELECT min(first_us), max(last_us) FROM chunk WHERE chunk.twin = head.twin)
           WHERE twin = ?""",
        (n_instants, twin),
    )
    segments.count_small(connection, twin)


def _forget(connection: Connection, twin: int, start_us: int, stop_us: int) -> None:
    """Forget what was derived from samples in an interval, by every model; what follows is assimilated anew."""
    connection.execute("DELETE FROM checkpoint WHERE twin = ? AND time_us >= ?", (twin, start_us))
    query = "DELETE FROM anomaly WHERE twin = ? AND start_us >= ? AND start_us < ?"
    connection.execute(query, (twin, start_us, stop_us))
    alarms.taken(connection, twin, start_us, stop_us)
    query = """SELECT DISTINCT version, coalesce(n_rows, length(value) / (8 * n)) FROM residual
               WHERE twin = ? AND last_us >= ? AND first_us < ?"""
    for version, n_rows in connection.execute(query, (twin, start_us, stop_us)).fetchall():
        residuals.forget(connection, twin, version, (n_rows - 1) // 2, start_us - 1, stop_us)
