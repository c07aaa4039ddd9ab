"""Arrays in the columns of tables: little-endian numbers, row by row."""

import numpy as np
from numpy.typing import NDArray


def instants(blob: bytes) -> NDArray[np.int64]:
    """Return instants or stream numbers, (n_times,)."""
    return np.frombuffer(blob, dtype="<i8")


def matrix(blob: bytes, n_rows: int, n_times: int) -> NDArray[np.float64]:
    """Return values as (n_rows, n_times).

    Rows that the twin has got since they were stored are missing, NaN; those that the caller does not know are left out.
    """
    stored: NDArray[np.float64] = np.frombuffer(blob, dtype="<f8").reshape(-1, n_times) if n_times else np.empty((0, 0))
    if stored.shape[0] == n_rows:
        return stored
    if stored.shape[0] > n_rows:
        return stored[:n_rows]
    values = np.full((n_rows, n_times), np.nan)
    values[: stored.shape[0]] = stored
    return values


def single(blob: bytes, n_rows: int, n_times: int) -> NDArray[np.float64]:
    """Return values that were stored in single or, by earlier releases, in double precision, (n_rows, n_times)."""
    kind = "<f4" if len(blob) == 4 * n_rows * n_times else "<f8"
    return np.frombuffer(blob, dtype=kind).reshape(n_rows, -1).astype(np.float64)
