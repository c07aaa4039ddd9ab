"""One step of assimilation written down: residuals, checkpoint, anomalies and messages in one transaction."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.instants import now_us
from service.store import anomalies, checkpoints, events, fleet, models, residuals, samples
from service.store.anomalies import AnomalyRow, Change
from service.store.checkpoints import Checkpoint
from service.store.connection import Connection
from service.store.fleet import Vital
from service.store.residuals import Residuals
from service.store.samples import Samples
from service.stream.messages import EventStretch, ResidualStretch, Stretch
from service.twins.registry import Entry

BLOCK = 5000
"""At most so many samples are assimilated in one step."""

Json = dict[str, Any]
_NONE = np.empty(0, dtype=np.int64)


class Outdated(Exception):
    """What was assimilated is no longer in the archive."""


@dataclass(frozen=True)
class Step:
    """What one step of assimilation found: ``after_us`` is the instant before it, ``after_gap`` whether that is long ago.

    ``revision`` is that of the archive that was read; ``checkpoint`` is None where the archive before was left out: nothing
    may go on from there after a restart.
    """

    version: int
    revision: int
    after_us: int
    after_gap: bool
    time_us: NDArray[np.int64]
    innovation_K: NDArray[np.float64]
    innovation_std_K: NDArray[np.float64]
    nis: NDArray[np.float64]
    told: NDArray[np.bool_]
    changes: list[Change]
    checkpoint: Checkpoint | None

    @property
    def span_us(self) -> tuple[int, int]:
        """The instants (after, until] that this step covers."""
        return self.after_us, int(self.time_us[-1])


@dataclass(frozen=True)
class Reading:
    """What the archive holds beyond a position.

    Attributes
    ----------
    seq
        The stream stood at this number.
    late_us
        First instant of a sample that lies before the position, came after it was read and matters; None if there is none.
    until_us
        What was read and lies behind the first long gap after ``late_us`` begins here; None if there is no such gap.
    fresh
        The next samples.
    told : (n_times,)
        Which of them nobody was told about yet.
    left
        How many samples lie beyond the position.
    revision
        How often samples had been taken out of the archive.
    """

    seq: int
    late_us: int | None
    until_us: int | None
    fresh: Samples
    told: NDArray[np.bool_]
    left: int
    revision: int


def stands(connection: Connection, twin: int) -> tuple[int, int | None]:
    """Return the last number of a twin's stream, and the version that is active; None if none is."""
    return samples.latest_seq(connection, twin), models.active_version(connection, twin)


def save(connection: Connection, twin: Entry, step: Step) -> tuple[None, Sequence[Stretch]]:
    """Store a step; residuals of samples that arrived live get stream numbers, the others zero.

    What was said provisionally of the same time is replaced. Outdated if samples were taken away meanwhile.
    """
    if samples.revision(connection, twin.key) != step.revision:
        raise Outdated(f"samples of '{twin.name}' were taken away while they were assimilated")
    n_told = int(step.told.sum())
    seq = np.zeros(step.time_us.size, dtype=np.int64)
    stretches: list[Stretch] = []
    if n_told:
        seq[step.told] = events.claim(connection, twin.key, n_told) + np.arange(n_told)
    columns = (np.ascontiguousarray(step.innovation_K.T), np.ascontiguousarray(step.innovation_std_K.T), step.nis)
    found = Residuals(seq, step.time_us, *columns, step.version)
    after_us, until_us = step.span_us
    residuals.forget(connection, twin.key, step.version, len(twin.sensors), after_us, until_us + 1)
    residuals.append(connection, twin.key, found)
    if n_told:
        stretches.append(ResidualStretch(twin.sensors, found.take(step.told)))
    ended = (
        anomalies.close(connection, twin.key, step.version, step.after_us, step.after_us + 1) if step.after_gap else []
    )
    fleet.note(connection, twin.key, step.version, vital_of(twin.sensors, step))
    rows = anomalies.apply(connection, twin.key, step.version, step.changes, step.span_us)
    stretches += _news(connection, twin, ended + rows)
    if step.checkpoint is not None:
        checkpoints.put(connection, twin.key, step.version, step.checkpoint, keep_previous=step.after_gap)
    return None, stretches


def vital_of(sensors: Sequence[str], step: Step) -> Vital | None:
    """Return the worst of the newest residuals of a step: of each sensor the last one counts; None where nothing was read."""
    scaled = np.abs(step.innovation_K / step.innovation_std_K)
    seen = np.isfinite(scaled)
    if not seen.any():
        return None
    last = seen.shape[0] - 1 - seen[::-1].argmax(axis=0)
    newest = np.where(seen.any(axis=0), scaled[last, np.arange(len(sensors))], -1.0)
    worst = int(newest.argmax())
    at = int(last[worst])
    return Vital(int(step.time_us[at]), sensors[worst], float(step.innovation_K[at, worst]), float(newest[worst]))


def _news(connection: Connection, twin: Entry, rows: Sequence[AnomalyRow]) -> list[Stretch]:
    """Return the messages that tell of anomalies."""
    if not rows:
        return []
    messages = [("anomaly", {"anomaly": row.wire()}) for row in rows]
    return [EventStretch(tuple(events.append(connection, twin.key, now_us(), messages)))]


def end_record(
    connection: Connection, twin: Entry, version: int, last_us: int, until_us: int
) -> tuple[None, Sequence[Stretch]]:
    """Write down that ``last_us`` is the last sample before a long gap, behind which ``until_us`` is known already."""
    return None, _news(connection, twin, anomalies.close(connection, twin.key, version, last_us, until_us))


def rewind(connection: Connection, twin: Entry, version: int, late_us: int, until_us: int | None) -> Checkpoint | None:
    """Go back to the last checkpoint before a late sample and forget those from there to ``until_us``.

    Residuals and anomalies stay until they are replaced one by one: the sample that came late may concern few of them.
    """
    checkpoint = checkpoints.before(connection, twin.key, version, late_us)
    after_us = -(2**62) if checkpoint is None else checkpoint.time_us
    checkpoints.forget(connection, twin.key, version, after_us, 2**62 if until_us is None else until_us)
    return _dated(connection, twin, checkpoint)


def resume(connection: Connection, twin: Entry, version: int) -> tuple[Checkpoint | None, int, int | None]:
    """Return where a version stands, the number at which the stream does, and the floor of its assimilation."""
    checkpoint = _dated(connection, twin, checkpoints.before(connection, twin.key, version))
    return checkpoint, samples.latest_seq(connection, twin.key), checkpoints.floor(connection, twin.key, version)


def lift_floor(connection: Connection, twin: Entry, version: int, window: int, from_us: int) -> int | None:
    """Return the floor of a version's assimilation from now on: where more than ``window`` samples lie behind ``from_us``,
    only the newest of them are looked at."""
    known = checkpoints.floor(connection, twin.key, version)
    if samples.count_after(connection, twin.key, from_us) <= window:
        return known
    at_us = samples.nth_newest_us(connection, twin.key, window)
    if at_us is None or (known is not None and known >= at_us):
        return known
    checkpoints.raise_floor(connection, twin.key, version, at_us)
    return at_us


def _dated(connection: Connection, twin: Entry, checkpoint: Checkpoint | None) -> Checkpoint | None:
    """Return a checkpoint that knows what of the archive it had read; those of earlier releases do not say."""
    if checkpoint is not None:
        checkpoint.body.setdefault("seq", samples.latest_seq(connection, twin.key))
        checkpoint.body.setdefault("recent_us", [checkpoint.time_us])
    return checkpoint


def look(
    connection: Connection,
    twin: Entry,
    read: Sequence[tuple[int, int, int]],
    told_seq: int,
    most: int,
    longest_gap_us: float,
    until_us: int | None,
    floor_us: int | None = None,
) -> Reading:
    """Return at most ``most`` samples between what was read and ``until_us``, and whether what was read has changed since.

    What lies before ``floor_us`` is not looked at.
    ``read`` are the stretches that were read, in order: (after, until] and the number at which the stream stood then.
    ``told_seq`` is the number up to which samples count as told.
    """
    seq = samples.latest_seq(connection, twin.key)
    least = -(2**62) if floor_us is None else floor_us
    late = [
        samples.arrived(connection, twin.key, number, max(after + 1, least), until + 1) for after, until, number in read
    ]
    first = _first_in_company(connection, twin.key, np.unique(np.concatenate([*late, _NONE])), longest_gap_us)
    after_us = read[-1][1] if read else None if floor_us is None else floor_us - 1
    known_us = None if first is None else _next_record(connection, twin.key, first, read[-1][1], longest_gap_us)
    fresh, told, revision = ahead(connection, twin, after_us, told_seq, most, until_us)
    return Reading(seq, first, known_us, fresh, told, samples.count_after(connection, twin.key, after_us), revision)


def ahead(
    connection: Connection, twin: Entry, after_us: int | None, told_seq: int, most: int, until_us: int | None
) -> tuple[Samples, NDArray[np.bool_], int]:
    """Return the next samples after an instant, which of them nobody was told about yet, and the archive's revision."""
    stop_us = samples.block_stop(connection, twin.key, after_us, most)
    if until_us is not None:
        stop_us = until_us if stop_us is None else min(stop_us, until_us)
    n = len(twin.channels)
    found = samples.select(connection, twin.key, n, range(n), None if after_us is None else after_us + 1, stop_us)
    fresh = Samples(found.time_us[:most], found.values[:, :most])
    told = np.zeros(fresh.time_us.size, dtype=np.bool_)
    if fresh.time_us.size:
        span = (int(fresh.time_us[0]), int(fresh.time_us[-1]) + 1)
        told = np.isin(fresh.time_us, samples.arrived(connection, twin.key, told_seq, *span))
    return fresh, told, samples.revision(connection, twin.key)


def outdates_inputs(connection: Connection, twin: Entry, read: Sequence[tuple[int, int, int]], until_us: int) -> bool:
    """Return whether what lies from ``until_us`` on was read with inputs that hold there wrongly, see ``look``.

    The state starts anew behind a long gap, but an input holds until its next sample: one that came late, too.
    """
    before = [(after, min(until, until_us - 1), number) for after, until, number in read if after < until_us]
    late = [samples.arrived(connection, twin.key, number, after + 1, until + 1) for after, until, number in before]
    late_us = np.concatenate([*late, _NONE])
    inputs = [row for row, name in enumerate(twin.channels) if name not in twin.sensors]
    if not (late_us.size and inputs):
        return False
    found = samples.select(connection, twin.key, len(twin.channels), inputs, int(late_us.min()), until_us + 1)
    held = np.isfinite(found.values)
    last = found.time_us[held.shape[1] - 1 - held[:, ::-1].argmax(axis=1)]
    return bool(np.isin(last[held.any(axis=1)], late_us).any())


def _first_in_company(
    connection: Connection, twin: int, instants: NDArray[np.int64], longest_gap_us: float
) -> int | None:
    """Return the first instant with another sample no further than a long gap away; None if each stands alone.

    What follows a long gap starts anew, so a sample between two of them changes nothing: most likely its clock is wrong.
    """
    reach = int(min(longest_gap_us, 2**61))
    for instant in instants.tolist():
        near = samples.arrived(connection, twin, -1, instant - reach, instant + reach + 1)
        if (near != instant).any():
            return int(instant)
    return None


def _next_record(connection: Connection, twin: int, first_us: int, last_us: int, longest_gap_us: float) -> int | None:
    """Return the first instant behind the first long gap between two instants; None if there is no such gap."""
    instants = np.unique(samples.arrived(connection, twin, -1, first_us, last_us + 1))
    gaps = np.flatnonzero(np.diff(instants) > longest_gap_us)
    return int(instants[gaps[0] + 1]) if gaps.size else None
