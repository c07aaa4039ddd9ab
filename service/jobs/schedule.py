"""Recalibration without being asked: on a schedule, and when an anomaly lasts, less and less often while it helps nothing."""

import asyncio
import contextlib
import logging
import time
from dataclasses import dataclass, field

from service.errors import Refusal
from service.jobs.runner import LEAST_SAMPLES, Jobs
from service.registry import Entry, Registry
from service.schemas import CalibrationRequest
from service.store import anomalies, twins
from service.store.database import Database

log = logging.getLogger("service.jobs")

TICK_S = 1.0
LONGEST_BACK_OFF_S = 86_400.0


@dataclass
class Watch:
    """What is known about one twin: when it was last recalibrated, and since when each open anomaly is known."""

    calibrated_s: float
    samples: int
    since_s: dict[int, float] = field(default_factory=dict)
    attempts: int = 0
    not_before_s: float = 0.0

    def due_by_schedule(self, now_s: float, every_s: float | None, samples: int) -> bool:
        """Return whether it is time again and there is something new to learn from."""
        return every_s is not None and now_s - self.calibrated_s >= every_s and samples > self.samples

    def due_by_anomaly(self, now_s: float, patience_s: float, open_ids: list[int]) -> bool:
        """Return whether an anomaly has lasted too long; each attempt doubles the patience until all anomalies end."""
        self.since_s = {key: self.since_s.get(key, now_s) for key in open_ids}
        if not open_ids:
            self.attempts, self.not_before_s = 0, 0.0
        lasted = any(now_s - since_s >= patience_s for since_s in self.since_s.values())
        if patience_s == 0.0 or not lasted or now_s < self.not_before_s:
            return False
        self.attempts += 1
        self.not_before_s = now_s + min(patience_s * 2.0**self.attempts, max(LONGEST_BACK_OFF_S, patience_s))
        return True


class Schedule:
    """Looks at every twin now and then."""

    def __init__(
        self, database: Database, registry: Registry, jobs: Jobs, every_s: float | None, patience_s: float
    ) -> None:
        """Begin to look; ``every_s`` None and ``patience_s`` 0 switch the triggers off."""
        self._database, self._registry, self._jobs = database, registry, jobs
        self._every_s, self._patience_s = every_s, patience_s
        self._watches: dict[int, Watch] = {}
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        """Stop looking."""
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(TICK_S)
            for twin in self._registry:
                try:
                    await self._look(twin, time.monotonic())
                except Refusal as error:
                    log.info("no recalibration", extra={"twin": twin.name, "reason": error.detail})

    async def _look(self, twin: Entry, now_s: float) -> None:
        head = await self._database.read(twins.get, twin.name)
        open_ids = await self._database.read(anomalies.open_ids, twin.key, head.active_version)
        watch = self._watches.setdefault(twin.key, Watch(now_s, 0))
        triggers = []
        if watch.due_by_schedule(now_s, self._every_s, head.samples):
            triggers.append("schedule")
        if watch.due_by_anomaly(now_s, self._patience_s, open_ids):
            triggers.append("anomaly")
        if triggers and head.samples >= LEAST_SAMPLES and not self._jobs.busy(twin):
            watch.calibrated_s, watch.samples = now_s, head.samples
            request = CalibrationRequest().model_dump(mode="json") | {"trigger": triggers[-1]}
            await self._jobs.start(twin, "calibration", request)
