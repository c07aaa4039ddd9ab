"""What of the archive a job looks at: all of it, its newest samples, or a thinned archive, so that years fit into memory."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from service.instants import format_instant
from service.store import samples
from service.store.connection import Connection
from service.store.samples import Samples
from service.store.segments import WITHIN, within
from twin_core.telemetry import one_of_each

_EVER = 2**62
How = Literal["all", "newest", "thinned"]


@dataclass(frozen=True)
class Selection:
    """Samples for a job, how they were chosen, and of how many; ``stride`` is 1 unless the archive was thinned."""

    samples: Samples
    of: int
    how: How
    stride: int = 1

    def wire(self) -> dict[str, Any]:
        """Return what a client is told of it."""
        time_us = self.samples.time_us
        ends = (
            {}
            if not time_us.size
            else {"start": format_instant(int(time_us[0])), "stop": format_instant(int(time_us[-1]))}
        )
        return {"how": self.how, "samples": int(time_us.size), "of": self.of, "stride": self.stride, **ends}

    @property
    def words(self) -> str:
        """What was chosen, for a line of text; empty where it was everything."""
        if self.how == "all":
            return ""
        n = f"{self.samples.time_us.size:,}"
        return (
            f"the newest {n} of {self.of:,} samples"
            if self.how == "newest"
            else f"{n} of {self.of:,} samples, one in {self.stride}"
        )


def choose(
    connection: Connection,
    twin: int,
    n_channels: int,
    start_us: int | None,
    stop_us: int | None,
    most: int,
    thin: bool,
    sensors: Sequence[int],
    averaged: Collection[int],
) -> Selection:
    """Return at most ``most`` samples of start <= time < stop: all, the newest, or with ``thin`` one of so many.

    Where the selection does not begin with the archive, its first sample has the inputs that hold there.

    Parameters
    ----------
    sensors
        Positions of the channels whose readings are kept as they were read.
    averaged
        Positions of inputs that hold until their next sample: a thinned archive has their mean up to its next sample,
        so that no heat is lost.
    """
    start = -_EVER if start_us is None else start_us
    stop = _EVER if stop_us is None else stop_us
    count = _count(connection, twin, start, stop)
    everything = range(n_channels)
    if count <= most:
        found = samples.select(connection, twin, n_channels, everything, start, stop)
        return Selection(_opened(connection, twin, n_channels, found, sensors), int(found.time_us.size), "all")
    if thin:
        kept, stride = _thinned(connection, twin, n_channels, start, stop, most, sensors, averaged)
        return Selection(kept, count, "thinned", stride)
    found = _newest(connection, twin, n_channels, start, stop, most)
    return Selection(_opened(connection, twin, n_channels, found, sensors), count, "newest")


def _count(connection: Connection, twin: int, start: int, stop: int) -> int:
    """Return how many samples lie in start <= time < stop; those that came in pieces count as often."""
    inside = "SELECT coalesce(sum(n), 0) FROM chunk WHERE twin = ? AND first_us >= ? AND last_us < ?"
    count = int(connection.execute(inside, (twin, start, stop)).fetchone()[0])
    edges = f"SELECT time FROM chunk WHERE {WITHIN} AND NOT (first_us >= ? AND last_us < ?)"
    for (time,) in connection.execute(edges, (*within(twin, start, stop), start, stop)):
        time_us = np.frombuffer(time, dtype="<i8")
        count += int(((time_us >= start) & (time_us < stop)).sum())
    return count


def _newest(connection: Connection, twin: int, n_channels: int, start: int, stop: int, most: int) -> Samples:
    """Return the last ``most`` samples of start <= time < stop, reading little more than they are."""
    length, first = 2 * most, start
    query = f"SELECT first_us, n FROM chunk WHERE {WITHIN} ORDER BY last_us DESC"
    held = 0
    for first_us, n in connection.execute(query, within(twin, start, stop)):
        held, first = held + n, first_us if held == 0 else min(first, first_us)
        if held >= length:  # chunks may overlap: one that began earlier may end later
            break
    else:
        first = start
    found = samples.select(connection, twin, n_channels, range(n_channels), max(first, start), stop)
    return Samples(found.time_us[-most:], found.values[:, -most:].copy())


def _opened(connection: Connection, twin: int, n_channels: int, found: Samples, sensors: Sequence[int]) -> Samples:
    """Return samples of which the first has the inputs that hold there, whenever they came."""
    if not found.time_us.size:
        return found
    missing = [row for row in range(n_channels) if row not in sensors and np.isnan(found.values[row, 0])]
    held = samples.last_values(connection, twin, n_channels, missing, int(found.time_us[0])) if missing else {}
    if held:
        values = found.values.copy()
        for row, value in held.items():
            values[row, 0] = value
        return Samples(found.time_us, values)
    return found


def _thinned(
    connection: Connection,
    twin: int,
    n_channels: int,
    start: int,
    stop: int,
    most: int,
    sensors: Sequence[int],
    averaged: Collection[int],
) -> tuple[Samples, int]:
    """Return about ``most`` samples, evenly over the archive, and of how many each is one; a channel at a time."""
    time_us = samples.select(connection, twin, n_channels, [], start, stop).time_us
    stride = -(-time_us.size // most)
    read = np.zeros(time_us.size, dtype=np.int64)
    for row in sensors:
        read += np.isfinite(samples.select(connection, twin, n_channels, [row], start, stop).values[0])
    kept = one_of_each(read == len(sensors), stride)
    values = np.empty((n_channels, kept.size))
    for row in range(n_channels):
        column = samples.select(connection, twin, n_channels, [row], start, stop).values[0]
        if row not in sensors:
            before = samples.last_values(connection, twin, n_channels, [row], int(time_us[0]))
            column = _held(column, before.get(row, np.nan))
        values[row] = _means(time_us, column, kept) if row in averaged else column[kept]
    return Samples(time_us[kept], values), stride


def _held(column: NDArray[np.float64], before: float) -> NDArray[np.float64]:
    """Return an input with each missing value replaced by the last one before it."""
    last = np.maximum.accumulate(np.where(np.isfinite(column), np.arange(column.size), -1))
    return np.where(last >= 0, column[np.maximum(last, 0)], before)


def _means(time_us: NDArray[np.int64], held: NDArray[np.float64], kept: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean of an input from each kept sample to the next; the last one as it is."""
    share = np.nan_to_num(held[:-1]) * np.diff(time_us)
    total = np.concatenate([[0.0], np.cumsum(share)])
    means = held[kept].copy()
    means[:-1] = np.where(np.isnan(held[kept[:-1]]), np.nan, np.diff(total[kept]) / np.diff(time_us[kept]))
    return np.asarray(means)
