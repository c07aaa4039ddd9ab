"""Arrays in the columns of tables: little-endian numbers, row by row."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray


def instants(blob: bytes) -> NDArray[np.int64]:
    """Return instants or stream numbers, (n_times,)."""
    return np.frombuffer(blob, dtype="<i8")


def matrix(blob: bytes, n_rows: int, n_times: int) -> NDArray[np.float64]:
    """Return values as (n_rows, n_times).

    Rows that the twin has got since they were stored are missing, NaN; those that the caller does not know are left out.
    """
    return _of_height(np.frombuffer(blob, dtype="<f8").reshape(-1, n_times) if n_times else np.empty((0, 0)), n_rows)


def _of_height(stored: NDArray[np.float64], n_rows: int) -> NDArray[np.float64]:
    if stored.shape[0] == n_rows:
        return stored
    if stored.shape[0] > n_rows:
        return stored[:n_rows]
    values = np.full((n_rows, stored.shape[1]), np.nan)
    values[: stored.shape[0]] = stored
    return values


def side_by_side(blobs: Sequence[bytes], n_rows: int, counts: Sequence[int]) -> NDArray[np.float64]:
    """Return the values of several blobs, each of so many instants, as one array (n_rows, sum of the counts).

    Neighbours of one size are read at once: most are single samples, of which an array each would cost ten times as much.
    """
    parts = [np.empty((n_rows, 0))]
    start = 0
    for (size, n_times), same in groupby(zip(map(len, blobs), counts, strict=True)):
        stop = start + sum(1 for _ in same)
        if stop == start + 1:
            parts.append(matrix(blobs[start], n_rows, n_times))
        elif n_times:
            block = np.frombuffer(b"".join(blobs[start:stop]), dtype="<f8").reshape(-1, size // (8 * n_times), n_times)
            parts.append(_of_height(block.swapaxes(0, 1).reshape(block.shape[1], -1), n_rows))
        start = stop
    return np.concatenate(parts, axis=1)


def single(blob: bytes, n_rows: int, n_times: int) -> NDArray[np.float64]:
    """Return values that were stored in single or, by earlier releases, in double precision, (n_rows, n_times)."""
    kind = "<f4" if len(blob) == 4 * n_rows * n_times else "<f8"
    return np.frombuffer(blob, dtype=kind).reshape(n_rows, -1).astype(np.float64)
