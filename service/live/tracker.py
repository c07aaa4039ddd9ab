"""The tracker of one twin: every sample updates the state of the active model; late ones send it back a little."""

import asyncio
import logging
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.live import progress
from service.live.engine import Engine
from service.live.position import Position, sampling_s, stretch
from service.live.progress import Step
from service.metrics import Metrics
from service.registry import Entry
from service.store import models
from service.store.anomalies import Change
from service.store.database import Database
from service.store.gone import TwinGone
from service.store.models import Active
from service.store.samples import Samples
from service.streams import Hub
from service.workbench import Filtered
from twin_core.anomaly import Thresholds, detect
from twin_core.errors import TwinError

log = logging.getLogger("service.live")

PAUSE_S = 0.05
"""Shortest time between two steps, so that samples sent one by one are assimilated together."""
RETRY_S = 2.0


@dataclass
class _News:
    """What happened since the tracker last looked."""

    times: list[NDArray[np.int64]] = field(default_factory=list)
    model: bool = True


@dataclass
class _Caution:
    """How the tracker gets past samples that cannot be assimilated.

    A block that fails is tried again in halves, down to ``stride`` samples, which are skipped; each skip in a row
    doubles the stride. A stretch of n such samples thus costs about 2 log2(n) attempts and at most n good samples.
    """

    most: int = progress.BLOCK
    stride: int = 1
    skipped_us: int | None = None

    def failed(self, time_us: NDArray[np.int64]) -> bool:
        """Hear that these samples failed; return whether they are skipped from now on."""
        if time_us.size > self.stride:
            self.most = max(int(time_us.size) // 2, self.stride)
            return False
        self.skipped_us = int(time_us[-1])
        self.most = self.stride = min(2 * self.stride, progress.BLOCK)
        return True

    def succeeded(self) -> None:
        """Hear that a block was assimilated."""
        self.most, self.stride, self.skipped_us = min(2 * self.most, progress.BLOCK), 1, None


class Tracker:
    """Keeps one twin's state up to date in the background."""

    def __init__(
        self, twin: Entry, database: Database, hub: Hub, engine: Engine, metrics: Metrics, thresholds: Thresholds
    ) -> None:
        """Start in the background; the state comes from the last checkpoint."""
        self.twin = twin
        self.active: Active | None = None
        self.position: Position | None = None
        self.trouble: str | None = None
        self._database, self._hub, self._engine = database, hub, engine
        self._metrics, self._thresholds = metrics, thresholds
        self._caution = _Caution()
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
            except TwinGone:
                return
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
        skipped_us = self._caution.skipped_us
        if skipped_us is not None and any(t.min() <= skipped_us for t in news.times):
            self._caution = _Caution()
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
        self._caution, self.trouble = _Caution(), None
        self.position = None if checkpoint is None else Position.of(checkpoint)
        self.active = active

    async def _go_back(self, late_us: int) -> None:
        assert self.active is not None
        checkpoint = await self._database.write(progress.rewind, self.twin, self.active.version, late_us)
        self.position = None if checkpoint is None else Position.of(checkpoint)

    async def _advance(self, told: NDArray[np.int64]) -> bool:
        """Assimilate the next block; return whether there may be more."""
        active, before, caution = self.active, self.position, self._caution
        assert active is not None
        known_us = None if before is None else before.time_us
        start_us = known_us if caution.skipped_us is None else caution.skipped_us
        fresh = await self._database.read(progress.next_samples, self.twin, start_us, caution.most)
        if fresh.time_us.size == 0:
            return False
        telemetry, held = stretch(self.twin, fresh, active.epoch_us, before)
        try:
            done = await self._engine.assimilate(active.document, telemetry, None if before is None else before.state)
        except (TwinError, ArithmeticError, ValueError) as error:
            self.trouble = str(error)
            if caution.failed(fresh.time_us):
                self._metrics.skipped.inc(int(fresh.time_us.size))
                extra = {"twin": self.twin.name, "reason": self.trouble, "samples": int(fresh.time_us.size)}
                log.warning("samples that cannot be assimilated are skipped", extra=extra)
            return True
        caution.succeeded()
        self.trouble = None
        await self._keep(active, before, fresh, done, held, told)
        return True

    async def _keep(
        self,
        active: Active,
        before: Position | None,
        fresh: Samples,
        done: Filtered,
        held: dict[str, float],
        told: NDArray[np.int64],
    ) -> None:
        """Look for anomalies in an assimilated block and write everything down."""
        time_us = fresh.time_us
        new = slice(-time_us.size, None)
        innovation, std, nis = done.innovation_K[new], done.innovation_std_K[new], done.nis[new]
        detector = None if before is None else before.detector
        reading = fresh.values[[self.twin.channels.index(s) for s in done.sensors]].T
        detector, intervals = detect(detector, done.sensors, time_us, reading, innovation, std, nis, self._thresholds)
        changes = [Change(i.sensor, i.kind, i.start, i.stop, i.score) for i in intervals]
        count = (0 if before is None else before.n_samples) + int(time_us.size)
        after = Position(int(time_us[-1]), count, done.state, held, detector, sampling_s(time_us, before))
        step = Step(active.version, time_us, innovation, std, nis, np.isin(time_us, told), changes, after.checkpoint())
        await self._hub.write(self.twin.key, progress.save, self.twin, step)
        self._metrics.assimilated.inc(int(time_us.size))
        self.position = after
