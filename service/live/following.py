"""From a block of samples to what is known after it: screened, filtered, looked through for anomalies."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.errors import Refusal
from service.live import screening
from service.live.engine import Engine
from service.live.position import RECENT, Json, Position, stretch
from service.live.progress import Step
from service.store import samples
from service.store.anomalies import Change
from service.store.database import Database
from service.store.errors import TwinGone
from service.store.models import Active
from service.store.samples import Samples
from service.twins.registry import Entry
from service.workbench.interface import Filtered, Stretch, Telemetry, Watch
from twin_core.anomaly import Thresholds
from twin_core.errors import TwinError


class NotFollowed(Exception):
    """The filter cannot make sense of samples, whatever the reason: it would come again with the same ones."""


@dataclass(frozen=True)
class Followed:
    """A filtered block: the readings as they were seen, what the filter says, and the inputs that hold at its end."""

    seen: Samples
    filtered: Filtered
    held: dict[str, float]


class Following:
    """Follows samples of one twin with a model."""

    def __init__(self, twin: Entry, database: Database, engine: Engine, thresholds: Thresholds) -> None:
        """Remember whose samples they are, and who looks at them."""
        self._twin, self._database = twin, database
        self._engine, self._thresholds = engine, thresholds

    async def filter(self, active: Active, before: Position | None, fresh: Samples) -> Followed:
        """Filter a block from a position and look for anomalies in it.

        Raises
        ------
        NotFollowed
            If the samples are to blame. What the database or a deleted twin is to blame for is raised as it is.
        """
        try:
            return await self._filter(active, before, fresh)
        except Exception as error:
            if isinstance(error, TwinGone) or self._database.is_fault(error):
                raise
            told = str(error) if isinstance(error, TwinError | Refusal) else f"{type(error).__name__}: {error}"
            raise NotFollowed(told) from error

    async def _filter(self, active: Active, before: Position | None, fresh: Samples) -> Followed:
        clean, seen = await self._readings(fresh, before)
        telemetry, held = stretch(self._twin, clean, active.epoch_us, before)
        state = None if before is None else before.state
        readings = {sensor: seen.values[self._twin.channels.index(sensor)] for sensor in self._twin.sensors}
        watch = Watch(readings, _detector(active, before, fresh), self._thresholds)
        return Followed(seen, await self._engine.assimilate(Stretch(active.document, telemetry, state, watch)), held)

    async def memory_s(self, active: Active, telemetry: Telemetry) -> float:
        """Return the longest time constant of a model where some telemetry begins."""
        return await self._engine.memory_s(active.document, telemetry)

    async def opened(self, fresh: Samples) -> Samples:
        """Return samples of which the first has the inputs that hold there, whenever they came."""
        inputs = [row for row, name in enumerate(self._twin.channels) if name not in self._twin.sensors]
        missing = [row for row in inputs if np.isnan(fresh.values[row, 0])]
        if missing:
            n, first_us = len(self._twin.channels), int(fresh.time_us[0])
            held = await self._database.read(samples.last_values, self._twin.key, n, missing, first_us)
            for row, value in held.items():
                fresh.values[row, 0] = value
        return fresh

    async def _readings(self, fresh: Samples, before: Position | None) -> tuple[Samples, Samples]:
        """Return a block without what the samples before it show to be no readings, and without missing ones alone."""
        context = None
        if before is not None:
            n = len(self._twin.channels)
            start_us = before.time_us - int(screening.CONTEXT * before.sampling_s * 1e6)
            span_us = (start_us, int(fresh.time_us[0]))
            context = await self._database.read(samples.select, self._twin.key, n, range(n), *span_us)
        return await screening.readings(self._twin, self._engine, context, fresh)

    def _in_order(
        self, sensors: tuple[str, ...], *matrices: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (n_times, n_sensors) matrices with a column per sensor of the twin, NaN where the model knows it not."""
        if sensors == self._twin.sensors:
            return matrices[0], matrices[1]
        ordered = [np.full((m.shape[0], len(self._twin.sensors)), np.nan) for m in matrices]
        for column, name in enumerate(self._twin.sensors):
            if name in sensors:
                for made, matrix in zip(ordered, matrices, strict=True):
                    made[:, column] = matrix[:, sensors.index(name)]
        return ordered[0], ordered[1]

    def step(
        self,
        active: Active,
        before: Position | None,
        after_us: int,
        done: Followed,
        seq: int,
        told: NDArray[np.bool_],
        revision: int,
        *,
        is_provisional: bool = False,
    ) -> tuple[Position, Step]:
        """Return where a filtered block leaves the filter, and what is to be written down.

        Parameters
        ----------
        active, before
            The model and the position from which the block was filtered.
        after_us
            The instant behind which the block says what is true.
        done
            The block.
        seq
            The number at which the stream stood when the archive was read.
        told : (n_times,)
            Which samples nobody was told about yet.
        revision
            Of the archive when it was read.
        is_provisional
            Whether the archive before the block was left out, to be assimilated later.
        """
        time_us, filtered = done.seen.time_us, done.filtered
        new = slice(-time_us.size, None)
        innovation, std, nis = filtered.innovation_K[new], filtered.innovation_std_K[new], filtered.nis[new]
        changes = [Change(i.sensor, i.kind, i.start, i.stop, i.score) for i in filtered.intervals]
        count = (0 if before is None else before.n_samples) + int(time_us.size)
        recent_us = [*([] if before is None else before.recent_us), *time_us[-RECENT:].tolist()][-RECENT:]
        after = Position(int(time_us[-1]), seq, count, filtered.state, done.held, filtered.watch or {}, recent_us)
        checkpoint = None if is_provisional else after.checkpoint()
        found = (time_us, *self._in_order(filtered.sensors, innovation, std), nis, told, changes)
        step = Step(active.version, revision, after_us, _is_after_gap(active, before, done.seen), *found, checkpoint)
        return after, step


def _is_after_gap(active: Active, before: Position | None, fresh: Samples) -> bool:
    """Return whether a block begins a long gap after the position before it."""
    return before is not None and bool(fresh.time_us[0] - before.time_us > active.longest_gap_us)


def _detector(active: Active, before: Position | None, fresh: Samples) -> Json | None:
    """Return what the search for anomalies goes on from; None where it begins, as it does behind a long gap."""
    return None if before is None or _is_after_gap(active, before, fresh) else before.detector
