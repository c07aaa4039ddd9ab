"""The tracker of one twin: every sample updates the state of the active model; late ones send it back a little."""

import asyncio
import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.live import progress
from service.live.engine import Engine
from service.live.progress import Step
from service.registry import Entry
from service.store import models
from service.store.anomalies import Change
from service.store.checkpoints import Checkpoint
from service.store.database import Database
from service.store.models import Active
from service.store.samples import Samples
from service.streams import Hub
from service.workbench import Telemetry
from twin_core.anomaly import detect
from twin_core.errors import TwinError

log = logging.getLogger("service.live")

PAUSE_S = 0.05
"""Shortest time between two steps, so that samples sent one by one are assimilated together."""
RETRY_S = 2.0

Json = dict[str, Any]


@dataclass(frozen=True)
class Position:
    """Where the assimilation stands: the last assimilated sample, its state, and the inputs that hold there."""

    time_us: int
    n_samples: int
    state: Json
    held: dict[str, float]
    detector: Json
    sampling_s: float

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> "Position":
        """Return the position that a checkpoint describes."""
        body = checkpoint.body
        return cls(
            checkpoint.time_us, checkpoint.n_samples, body["state"], body["held"], body["detector"], body["sampling_s"]
        )

    def checkpoint(self) -> Checkpoint:
        """Return the checkpoint that describes this position."""
        names = ("state", "held", "detector", "sampling_s")
        return Checkpoint(self.time_us, self.n_samples, {name: getattr(self, name) for name in names})


@dataclass
class _News:
    """What happened since the tracker last looked."""

    times: list[NDArray[np.int64]] = field(default_factory=list)
    model: bool = True


class Tracker:
    """Keeps one twin's state up to date in the background."""

    def __init__(self, twin: Entry, database: Database, hub: Hub, engine: Engine) -> None:
        """Start in the background; the state comes from the last checkpoint."""
        self.twin = twin
        self.active: Active | None = None
        self.position: Position | None = None
        self.trouble: str | None = None
        self._database, self._hub, self._engine = database, hub, engine
        self._news, self._wake, self._idle = _News(), asyncio.Event(), asyncio.Event()
        self._wake.set()
        self._task = asyncio.create_task(self._run())

    def arrived(self, time_us: NDArray[np.int64]) -> None:
        """Hear of newly stored samples."""
        if self.active is not None:
            self._news.times.append(time_us)
        self._idle.clear()
        self._wake.set()

    def model_changed(self) -> None:
        """Hear that another model is active."""
        self._news.model = True
        self._idle.clear()
        self._wake.set()

    async def settled(self, timeout_s: float) -> bool:
        """Return whether everything stored so far is assimilated, after waiting for it a while."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._idle.wait()
        except TimeoutError:
            return False
        return True

    async def close(self) -> None:
        """Stop."""
        self._task.cancel()
        await asyncio.wait([self._task])

    async def _run(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            news, self._news = self._news, _News(model=False)
            try:
                await self._take_in(news)
                self.trouble = None
            except LookupError:
                return  # the twin was deleted
            except TwinError as error:
                self.trouble = str(error)
                log.warning("assimilation failed", extra={"twin": self.twin.name, "reason": self.trouble})
            except Exception as error:
                self.trouble = f"{type(error).__name__}: {error}"
                log.exception("assimilation failed unexpectedly", extra={"twin": self.twin.name})
                self._news.model = True
                await asyncio.sleep(RETRY_S)
            if not self._wake.is_set():
                self._idle.set()
            await asyncio.sleep(PAUSE_S)

    async def _take_in(self, news: _News) -> None:
        if news.model:
            await self._load()
        if self.active is None:
            return
        late = [t for t in news.times if self.position is not None and t.min() <= self.position.time_us]
        if late:
            await self._go_back(int(min(t.min() for t in late)))
        told = np.unique(np.concatenate([np.empty(0, dtype=np.int64), *news.times]))
        while await self._advance(told):
            continue

    async def _load(self) -> None:
        """Find the active model and where its assimilation stands."""
        active = await self._database.read(models.active, self.twin.key)
        if active is None:
            self.active, self.position = None, None
            return
        if self.active is not None and self.active.version == active.version:
            return
        checkpoint = await self._database.write(progress.switch, self.twin, active.version)
        self.position = None if checkpoint is None else Position.of(checkpoint)
        self.active = active

    async def _go_back(self, late_us: int) -> None:
        assert self.active is not None
        checkpoint = await self._database.write(progress.rewind, self.twin, self.active.version, late_us)
        self.position = None if checkpoint is None else Position.of(checkpoint)

    async def _advance(self, told: NDArray[np.int64]) -> bool:
        """Assimilate the next block; return whether there may be more."""
        active, before = self.active, self.position
        assert active is not None
        start_us = None if before is None else before.time_us
        found = await self._database.read(progress.next_samples, self.twin, start_us)
        fresh = slice(0 if before is None else 1, None)
        if found.time_us[fresh].size == 0:
            return False
        telemetry, held = _telemetry(self.twin, found, active.epoch_us, {} if before is None else before.held)
        done = await self._engine.assimilate(active.document, telemetry, None if before is None else before.state)
        innovation, std = done.innovation_K[fresh], done.innovation_std_K[fresh]
        time_us, nis = found.time_us[fresh], done.nis[fresh]
        detector, intervals = detect(
            None if before is None else before.detector, done.sensors, time_us, innovation, std
        )
        changes = [Change(i.sensor, "residual", i.start, i.stop, i.score) for i in intervals]
        count = (0 if before is None else before.n_samples) + int(time_us.size)
        sampling_s = _sampling_s(found.time_us, before)
        after = Position(int(time_us[-1]), count, done.state, held, detector, sampling_s)
        step = Step(active.version, time_us, innovation, std, nis, np.isin(time_us, told), changes, after.checkpoint())
        await self._hub.write(self.twin.key, progress.save, self.twin, step)
        self.position = after
        return True


def _telemetry(
    twin: Entry, found: Samples, epoch_us: int, held: dict[str, float]
) -> tuple[Telemetry, dict[str, float]]:
    """Return a block for the filter, with inputs that were last seen before it, and the inputs that hold at its end."""
    values: dict[str, NDArray[np.float64]] = {}
    after = dict(held)
    for row, name in enumerate(twin.channels):
        column = found.values[row].copy()
        if name not in twin.sensors:
            if np.isnan(column[0]) and name in held:
                column[0] = held[name]
            seen = np.flatnonzero(np.isfinite(column))
            if seen.size:
                after[name] = float(column[seen[-1]])
        if name in twin.sensors or np.isfinite(column).any():
            values[name] = column
    return Telemetry(epoch_us, found.time_us, values), after


def _sampling_s(time_us: NDArray[np.int64], before: Position | None) -> float:
    """Return the usual distance of samples."""
    if time_us.size > 10 or before is None:
        return float(np.median(np.diff(time_us))) / 1e6 if time_us.size > 1 else 60.0
    return before.sampling_s
