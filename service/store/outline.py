"""Outlines: of every large chunk the samples that hold its extremes, so that a plot of years reads a twentieth of it.

The extremes of a union are among the extremes of its parts: a plot drawn from outlines shows every spike that a plot of
all samples would. Samples and residuals have the same kind of chunks, so both have outlines.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from service.store import blobs
from service.store.connection import Connection
from service.store.merge import collapse

Table = Literal["chunk", "residual"]

PIECE = 512
"""Of so many samples the outline keeps those in which any row has its least or greatest value."""


@dataclass(frozen=True)
class Part:
    """One chunk of a plot: its outline, or None where all of it is needed, and how many instants it holds."""

    chunk: int
    instants: int
    time_us: NDArray[np.int64] | None
    values: NDArray[np.float64] | None


def put(
    connection: Connection, table: Table, chunk: int, time_us: NDArray[np.int64], values: NDArray[np.float64]
) -> None:
    """Store the outline of a chunk, unless the chunk is small.

    Parameters
    ----------
    time_us, values : (n_times,), (n_rows, n_times)
        The chunk, in any order.
    """
    if time_us.size < PIECE:
        return
    time_us, values = collapse(time_us, values)
    kept = _extremes(values)
    connection.execute(
        f"INSERT INTO {table}_outline (chunk, instants, time, value) VALUES (?, ?, ?, ?)",
        (
            chunk,
            int(time_us.size),
            np.ascontiguousarray(time_us[kept], dtype="<i8").data,
            np.ascontiguousarray(values[:, kept], dtype="<f8" if table == "chunk" else "<f4").data,
        ),
    )


def _extremes(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return where any row has its least or greatest value within each piece, and the ends, in order."""
    n_rows, n_times = values.shape
    n_whole = n_times - n_times % PIECE
    kept = [np.array([0, n_times - 1])]
    for first, length in ((0, PIECE), (n_whole, max(n_times - n_whole, 1))):
        stop = n_whole if first == 0 else n_times
        pieces = values[:, first:stop].reshape(n_rows, -1, length)
        if pieces.size:
            begin = first + length * np.arange(pieces.shape[1])
            missing = np.isnan(pieces)
            kept.append((begin + np.where(missing, np.inf, pieces).argmin(axis=2)).ravel())
            kept.append((begin + np.where(missing, -np.inf, pieces).argmax(axis=2)).ravel())
    return np.unique(np.concatenate(kept))


def parts(
    connection: Connection,
    table: Table,
    spans: list[tuple[int, int, int]],
    start_us: int,
    stop_us: int,
    n_rows: int,
) -> list[Part]:
    """Return chunks with their outlines; one that the interval cuts, or that overlaps another one, has none.

    Parameters
    ----------
    spans
        (id, first instant, last instant) of chunks, in the order of the first instant.
    start_us, stop_us
        The interval wanted.
    n_rows
        Rows of a chunk's values.
    """
    first, last = (np.array([span[i] for span in spans], dtype=np.int64) for i in (1, 2))
    reach = np.maximum.accumulate(last)
    apart = np.ones(len(spans), dtype=np.bool_)
    apart[1:] &= first[1:] > reach[:-1]
    apart[:-1] &= last[:-1] < first[1:]
    whole = apart & (first >= start_us) & (last < stop_us)
    found = []
    for (chunk, _, _), is_whole in zip(spans, whole.tolist(), strict=True):
        query = f"SELECT instants, time, value FROM {table}_outline WHERE chunk = ?"
        row = connection.execute(query, (chunk,)).fetchone() if is_whole else None
        if row is None:
            found.append(Part(chunk, 0, None, None))
        else:
            time_us = blobs.instants(row[1])
            read = blobs.matrix if table == "chunk" else blobs.single
            found.append(Part(chunk, row[0], time_us, read(row[2], n_rows, time_us.size)))
    return found
