"""Residuals of one model version: chunks like those of samples, replaced from an instant on when late samples arrive.

The value array has 2 n_sensors + 1 rows in single precision: innovations in K, their predicted standard deviations in K,
and the NIS. They take less room than the samples that they belong to. Residuals of samples that were assimilated in arrears
carry stream number 0, which is not stored: nobody was told about them one by one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.store import blobs, outline
from service.store.connection import Connection

MOST_SMALL_CHUNKS = 64
"""So many small chunks in a row are rewritten as one."""


@dataclass(frozen=True)
class Residuals:
    """Residuals in the order of time.

    Attributes
    ----------
    seq, time_us : (n_times,)
    innovation_K, innovation_std_K : (n_sensors, n_times)
    nis : (n_times,)
    version
        Of the model that predicted.
    """

    seq: NDArray[np.int64]
    time_us: NDArray[np.int64]
    innovation_K: NDArray[np.float64]
    innovation_std_K: NDArray[np.float64]
    nis: NDArray[np.float64]
    version: int

    def take(self, keep: NDArray[np.bool_]) -> "Residuals":
        """Return those that a mask selects."""
        return Residuals(
            self.seq[keep],
            self.time_us[keep],
            self.innovation_K[:, keep],
            self.innovation_std_K[:, keep],
            self.nis[keep],
            self.version,
        )


def _pack(residuals: Residuals) -> NDArray[np.float64]:
    return np.vstack([residuals.innovation_K, residuals.innovation_std_K, residuals.nis[None, :]])


def _unpack(n_sensors: int, version: int, seq: bytes, time: bytes, value: bytes) -> Residuals:
    time_us = blobs.instants(time)
    matrix = blobs.single(value, 2 * n_sensors + 1, time_us.size)
    return Residuals(
        blobs.instants(seq) if seq else np.zeros_like(time_us),
        time_us,
        matrix[:n_sensors],
        matrix[n_sensors:-1],
        matrix[-1],
        version,
    )


def append(connection: Connection, twin: int, residuals: Residuals) -> None:
    """Store residuals, and gather the last chunks into one if there are many small ones."""
    if residuals.time_us.size == 0:
        return
    _insert(connection, twin, residuals)
    if residuals.time_us.size < outline.PIECE:
        _compact(connection, twin, residuals.version, residuals.innovation_K.shape[0])


def _compact(connection: Connection, twin: int, version: int, n_sensors: int) -> None:
    """Rewrite the last chunks as one if all of them are small: samples that come one by one make one chunk each."""
    rows = connection.execute(
        "SELECT id, n FROM residual WHERE twin = ? AND version = ? ORDER BY last_us DESC LIMIT ?",
        (twin, version, MOST_SMALL_CHUNKS),
    ).fetchall()
    if len(rows) < MOST_SMALL_CHUNKS or max(n for _, n in rows) >= outline.PIECE:
        return
    found = []
    for chunk, _ in reversed(rows):
        row = connection.execute("SELECT seq, time, value FROM residual WHERE id = ?", (chunk,)).fetchone()
        found.append(_unpack(n_sensors, version, *row))
        connection.execute("DELETE FROM residual WHERE id = ?", (chunk,))
    _insert(connection, twin, _join(found, n_sensors, version))


def _insert(connection: Connection, twin: int, residuals: Residuals) -> None:
    packed = _pack(residuals)
    row = connection.execute(
        """INSERT INTO residual (twin, version, n, first_us, last_us, last_seq, seq, time, value, n_rows)
           VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?) RETURNING id""",
        (
            twin,
            residuals.version,
            int(residuals.time_us.size),
            int(residuals.time_us[0]),
            int(residuals.time_us[-1]),
            int(residuals.seq.max()),
            np.ascontiguousarray(residuals.seq, dtype="<i8").data if residuals.seq.any() else b"",
            np.ascontiguousarray(residuals.time_us, dtype="<i8").data,
            np.ascontiguousarray(packed, dtype="<f4").data,
            packed.shape[0],
        ),
    )
    outline.put(connection, "residual", int(row.fetchone()[0]), residuals.time_us, packed)


def forget(connection: Connection, twin: int, version: int, n_sensors: int, after_us: int, until_us: int) -> None:
    """Forget one version's residuals of after < time < until."""
    rows = connection.execute(
        """SELECT id, seq, time, value FROM residual
           WHERE twin = ? AND last_us > ? AND first_us < ? AND version = ?""",
        (twin, after_us, until_us, version),
    ).fetchall()
    for chunk, seq, time, value in rows:
        connection.execute("DELETE FROM residual WHERE id = ?", (chunk,))
        residuals = _unpack(n_sensors, version, seq, time, value)
        append(connection, twin, residuals.take((residuals.time_us <= after_us) | (residuals.time_us >= until_us)))


def select(
    connection: Connection,
    twin: int,
    version: int,
    n_sensors: int,
    start_us: int | None = None,
    stop_us: int | None = None,
) -> Residuals:
    """Return one version's residuals with start <= time < stop."""
    start = start_us if start_us is not None else -(2**62)
    stop = stop_us if stop_us is not None else 2**62
    query = """SELECT seq, time, value FROM residual WHERE twin = ? AND last_us >= ? AND first_us < ? AND version = ?
               ORDER BY first_us"""
    found = [_unpack(n_sensors, version, *row) for row in connection.execute(query, (twin, start, stop, version))]
    whole = _join(found, n_sensors, version)
    return whole.take((whole.time_us >= start) & (whole.time_us < stop))


def overview(
    connection: Connection,
    twin: int,
    version: int,
    n_sensors: int,
    start_us: int | None,
    stop_us: int | None,
    max_points: int,
) -> tuple[Residuals, int]:
    """Return residuals among which are the extremes of start <= time < stop, and how many there are in all."""
    start = start_us if start_us is not None else -(2**62)
    stop = stop_us if stop_us is not None else 2**62
    query = """SELECT id, first_us, last_us, n FROM residual WHERE twin = ? AND last_us >= ? AND first_us < ?
               AND version = ? ORDER BY first_us"""
    spans = connection.execute(query, (twin, start, stop, version)).fetchall()
    n_rows = 2 * n_sensors + 1
    if sum(span[3] for span in spans) // outline.PIECE * 2 * n_rows < max_points:
        found = select(connection, twin, version, n_sensors, start_us, stop_us)
        return found, int(found.time_us.size)
    chosen, left_out = [], 0
    for part in outline.parts(connection, "residual", [span[:3] for span in spans], start, stop, n_rows):
        if part.time_us is None or part.values is None:
            row = connection.execute("SELECT seq, time, value FROM residual WHERE id = ?", (part.chunk,)).fetchone()
            chosen.append(_unpack(n_sensors, version, *row))
        else:
            unnumbered = np.zeros(part.time_us.size, dtype="<i8").tobytes()
            chosen.append(_unpack(n_sensors, version, unnumbered, part.time_us.tobytes(), part.values.tobytes()))
            left_out += part.instants - part.time_us.size
    whole = _join(chosen, n_sensors, version)
    found = whole.take((whole.time_us >= start) & (whole.time_us < stop))
    return found, int(found.time_us.size) + left_out


def _join(parts: list[Residuals], n_sensors: int, version: int) -> Residuals:
    empty = np.empty(0, dtype=np.int64)
    nothing = Residuals(empty, empty, np.empty((n_sensors, 0)), np.empty((n_sensors, 0)), np.empty(0), version)
    parts = [nothing, *parts]
    return Residuals(
        np.concatenate([part.seq for part in parts]),
        np.concatenate([part.time_us for part in parts]),
        np.concatenate([part.innovation_K for part in parts], axis=1),
        np.concatenate([part.innovation_std_K for part in parts], axis=1),
        np.concatenate([part.nis for part in parts]),
        version,
    )


def since_seq(connection: Connection, twin: int, n_sensors: int, after_seq: int) -> list[Residuals]:
    """Return the residuals after one stream number, in stretches of one version each."""
    query = "SELECT version, seq, time, value FROM residual WHERE twin = ? AND last_seq > ? ORDER BY last_seq"
    found = [
        _unpack(n_sensors, version, seq, time, value)
        for version, seq, time, value in connection.execute(query, (twin, after_seq))
    ]
    return [residuals.take(residuals.seq > after_seq) for residuals in found]
