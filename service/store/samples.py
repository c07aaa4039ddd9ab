"""Samples as they are read: segments found by time or by their numbers in the stream, joined in the order of time."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.store import outline
from service.store.batch import Batch
from service.store.blobs import instants, matrix
from service.store.connection import Connection
from service.store.errors import TwinGone
from service.store.merge import collapse
from service.store.quarters import EVER_US
from service.store.segments import WITHIN, unpack, within


@dataclass(frozen=True)
class Samples:
    """Samples in the order of time: (n_times,) instants, (n_channels, n_times) values with NaN where missing."""

    time_us: NDArray[np.int64]
    values: NDArray[np.float64]


def select(
    connection: Connection,
    twin: int,
    n_channels: int,
    rows: Sequence[int],
    start_us: int | None = None,
    stop_us: int | None = None,
) -> Samples:
    """Return the samples with start <= time < stop, of the channels whose positions ``rows`` names."""
    start = start_us if start_us is not None else -EVER_US
    stop = stop_us if stop_us is not None else EVER_US
    chosen = list(rows)
    times, values = [np.empty(0, dtype=np.int64)], [np.empty((len(chosen), 0))]
    query = f"SELECT time, value FROM chunk WHERE {WITHIN} ORDER BY first_us, id"
    for time, value in connection.execute(query, within(twin, start, stop)):
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
    start = start_us if start_us is not None else -EVER_US
    stop = stop_us if stop_us is not None else EVER_US
    query = f"SELECT id, first_us, last_us, n FROM chunk WHERE {WITHIN} ORDER BY first_us"
    spans = connection.execute(query, within(twin, start, stop)).fetchall()
    if sum(span[3] for span in spans) // outline.PIECE * 2 * n_channels < max_points:
        found = select(connection, twin, n_channels, rows, start_us, stop_us)
        return found, int(found.time_us.size)
    chosen = list(rows)
    times, values = [np.empty(0, dtype=np.int64)], [np.empty((len(chosen), 0))]
    left_out = 0
    parts = outline.parts(connection, "chunk", [span[:3] for span in spans], start, stop, n_channels)
    for part, (chunk, first_us, _, _) in zip(parts, spans, strict=True):
        time_us, held = part.time_us, part.values
        if time_us is None or held is None:
            query = "SELECT time, value FROM chunk WHERE id = ? AND first_us = ?"
            time, value = connection.execute(query, (chunk, first_us)).fetchone()
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


def last_us(connection: Connection, twin: int) -> int | None:
    """Return the last instant of the archive; None while it is empty."""
    row = connection.execute("SELECT last_us FROM head WHERE twin = ?", (twin,)).fetchone()
    if row is None:
        raise TwinGone(f"twin {twin} is gone")
    return None if row[0] is None else int(row[0])


def revision(connection: Connection, twin: int) -> int:
    """Return how often stored samples of a twin were taken away."""
    row = connection.execute("SELECT revision FROM head WHERE twin = ?", (twin,)).fetchone()
    if row is None:
        raise TwinGone(f"twin {twin} is gone")
    return int(row[0])


def arrived(connection: Connection, twin: int, after_seq: int, start_us: int, stop_us: int) -> NDArray[np.int64]:
    """Return the instants, start <= time < stop, of samples that came after one stream number, in any order."""
    found = [np.empty(0, dtype=np.int64)]
    query = f"SELECT seq, time FROM chunk WHERE {WITHIN} AND last_seq > ?"
    for seq, time in connection.execute(query, (*within(twin, start_us, stop_us), after_seq)):
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
    for last_us, n in connection.execute(query, (twin, -EVER_US if start_us is None else start_us)):
        total += n
        if total >= n_rows:
            return int(last_us) + 1
    return None


def count_after(connection: Connection, twin: int, after_us: int | None) -> int:
    """Return how many samples lie behind an instant; those that came in pieces count as often."""
    after = -EVER_US if after_us is None else after_us
    query = "SELECT coalesce(sum(n), 0) FROM chunk WHERE twin = ? AND last_us > ? AND first_us > ?"
    count = int(connection.execute(query, (twin, after, after)).fetchone()[0])
    query = f"SELECT time FROM chunk WHERE {WITHIN}"
    for (time,) in connection.execute(query, within(twin, after + 1, after + 1)):
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
    found, start_us = 0, -EVER_US
    query = "SELECT first_us, n FROM chunk WHERE twin = ? ORDER BY last_us DESC"
    for first_us, n in connection.execute(query, (twin,)):
        found, start_us = found + n, first_us if found == 0 else min(start_us, first_us)
        if found >= 2 * count:  # chunks may overlap: one that began earlier may end later
            break
    else:
        start_us = -EVER_US
    held = select(connection, twin, n_channels, range(n_channels), start_us)
    return Samples(held.time_us[-count:], held.values[:, -count:])


def newest_first(
    connection: Connection, twin: int, n_channels: int, after_seq: int, is_wanted: Callable[[int], bool]
) -> Iterator[Batch]:
    """Yield the chunks with samples that came after a stream number, those that end latest first, one in memory at a time.

    ``is_wanted`` is asked with the last instant of each chunk before it is read; with the first one that is not, they end.
    """
    places = "SELECT id, first_us, last_us FROM chunk WHERE twin = ? AND last_seq > ? ORDER BY last_us DESC"
    query = "SELECT time, value, received FROM chunk WHERE id = ? AND first_us = ?"
    for chunk, first_us, last_us in connection.execute(places, (twin, after_seq)):
        if not is_wanted(last_us):
            return
        yield unpack(n_channels, *connection.execute(query, (chunk, first_us)).fetchone())


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
                found[row] = max(found.get(row, (-EVER_US, 0.0)), (int(time_us[best]), float(held[row, best])))
    return {row: value for row, (_, value) in found.items()}
