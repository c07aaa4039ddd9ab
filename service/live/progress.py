"""One step of assimilation written down: residuals, checkpoint, anomalies and messages in one transaction."""

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.instants import now_us
from service.messages import EventStretch, ResidualStretch, Stretch
from service.registry import Entry
from service.store import anomalies, checkpoints, events, residuals, samples
from service.store.anomalies import Change
from service.store.checkpoints import Checkpoint
from service.store.residuals import Residuals
from service.store.samples import Samples

BLOCK = 5000
"""At most so many samples are assimilated in one step."""

Json = dict[str, Any]


@dataclass(frozen=True)
class Step:
    """What one step of assimilation found."""

    version: int
    time_us: NDArray[np.int64]
    innovation_K: NDArray[np.float64]
    innovation_std_K: NDArray[np.float64]
    nis: NDArray[np.float64]
    told: NDArray[np.bool_]
    changes: list[Change]
    checkpoint: Checkpoint


def save(connection: sqlite3.Connection, twin: Entry, step: Step) -> tuple[None, Sequence[Stretch]]:
    """Store a step; residuals of samples that arrived live get stream numbers, the others zero."""
    n_told = int(step.told.sum())
    seq = np.zeros(step.time_us.size, dtype=np.int64)
    stretches: list[Stretch] = []
    if n_told:
        seq[step.told] = events.claim(connection, twin.key, n_told) + np.arange(n_told)
    columns = (np.ascontiguousarray(step.innovation_K.T), np.ascontiguousarray(step.innovation_std_K.T), step.nis)
    found = Residuals(seq, step.time_us, *columns, step.version)
    residuals.append(connection, twin.key, found)
    if n_told:
        stretches.append(ResidualStretch(twin.sensors, found.take(step.told)))
    rows = anomalies.apply(connection, twin.key, step.version, step.changes)
    if rows:
        messages = [("anomaly", {"anomaly": row.wire()}) for row in rows]
        stretches.append(EventStretch(tuple(events.append(connection, twin.key, now_us(), messages))))
    checkpoints.put(connection, twin.key, step.version, step.checkpoint)
    return None, stretches


def rewind(connection: sqlite3.Connection, twin: Entry, version: int, late_us: int) -> Checkpoint | None:
    """Go back to the last checkpoint before a late sample and forget what was derived after it."""
    checkpoint = checkpoints.before(connection, twin.key, version, late_us)
    after_us = -(2**62) if checkpoint is None else checkpoint.time_us
    checkpoints.forget_after(connection, twin.key, version, after_us)
    residuals.truncate(connection, twin.key, version, len(twin.sensors), after_us)
    anomalies.rewind(connection, twin.key, version, after_us)
    return checkpoint


def switch(connection: sqlite3.Connection, twin: Entry, version: int) -> Checkpoint | None:
    """Let another version take over: end what was said by the others, return where it stands itself."""
    row = connection.execute("SELECT last_us FROM head WHERE twin = ?", (twin.key,)).fetchone()
    if row is not None and row[0] is not None:
        anomalies.close_others(connection, twin.key, version, row[0])
    return checkpoints.before(connection, twin.key, version)


def next_samples(connection: sqlite3.Connection, twin: Entry, after_us: int | None, most: int) -> Samples:
    """Return at most ``most`` samples after an instant."""
    stop_us = samples.block_stop(connection, twin.key, after_us, most)
    n = len(twin.channels)
    start_us = None if after_us is None else after_us + 1
    found = samples.select(connection, twin.key, n, range(n), start_us, stop_us)
    return Samples(found.time_us[:most], found.values[:, :most])
