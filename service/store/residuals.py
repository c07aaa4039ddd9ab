"""Residuals of one model version: chunks like those of samples, replaced from an instant on when late samples arrive.

The value array has 2 n_sensors + 1 rows: innovations in K, their predicted standard deviations in K, and the NIS.
Residuals of samples that were assimilated in arrears carry stream number 0: nobody was told about them one by one.
"""

import sqlite3
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
    matrix = np.frombuffer(value, dtype="<f8").reshape(2 * n_sensors + 1, -1)
    return Residuals(
        np.frombuffer(seq, dtype="<i8"),
        np.frombuffer(time, dtype="<i8"),
        matrix[:n_sensors],
        matrix[n_sensors:-1],
        matrix[-1],
        version,
    )


def append(connection: sqlite3.Connection, twin: int, residuals: Residuals) -> None:
    """Store residuals."""
    if residuals.time_us.size == 0:
        return
    connection.execute(
        """INSERT INTO residual (twin, version, n, first_us, last_us, last_seq, seq, time, value)
           VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)""",
        (
            twin,
            residuals.version,
            int(residuals.time_us.size),
            int(residuals.time_us[0]),
            int(residuals.time_us[-1]),
            int(residuals.seq.max()),
            np.ascontiguousarray(residuals.seq, dtype="<i8").data,
            np.ascontiguousarray(residuals.time_us, dtype="<i8").data,
            np.ascontiguousarray(_pack(residuals), dtype="<f8").data,
        ),
    )


def truncate(connection: sqlite3.Connection, twin: int, version: int, n_sensors: int, after_us: int) -> None:
    """Forget one version's residuals after an instant."""
    rows = connection.execute(
        """SELECT id, seq, time, value FROM residual
           WHERE twin = ? AND last_us > ? AND version = ?""",
        (twin, after_us, version),
    ).fetchall()
    for chunk, seq, time, value in rows:
        connection.execute("DELETE FROM residual WHERE id = ?", (chunk,))
        residuals = _unpack(n_sensors, version, seq, time, value)
        append(connection, twin, residuals.take(residuals.time_us <= after_us))


def select(
    connection: sqlite3.Connection,
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


def since_seq(connection: sqlite3.Connection, twin: int, n_sensors: int, after_seq: int) -> list[Residuals]:
    """Return the residuals after one stream number, in stretches of one version each."""
    query = "SELECT version, seq, time, value FROM residual WHERE twin = ? AND last_seq > ? ORDER BY last_seq"
    found = [
        _unpack(n_sensors, version, seq, time, value)
        for version, seq, time, value in connection.execute(query, (twin, after_seq))
    ]
    return [residuals.take(residuals.seq > after_seq) for residuals in found]
