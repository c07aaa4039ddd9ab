"""Work without being asked: recalibration on a schedule and when an anomaly lasts, and one diagnosis of a refuted model."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from service.errors import Refusal
from service.fleet.ownership import Ownership
from service.instants import now_us
from service.jobs.runner import LEAST_SAMPLES, Jobs
from service.schemas import CalibrationRequest, DiagnosisRequest
from service.store import audit, fleet, jobs
from service.store.database import Database
from service.store.fleet import Duty
from service.twins.registry import Entry, Registry
from twin_core.anomaly import adjusted, discoveries

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
    refuted_s: float | None = None

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

    def due_by_refutation(self, now_s: float, patience_s: float, is_refuted: bool) -> bool:
        """Return whether the model has been refuted for as long as an anomaly must last: a recalibration goes first."""
        if not is_refuted:
            self.refuted_s = None
        elif self.refuted_s is None:
            self.refuted_s = now_s
        return patience_s > 0.0 and self.refuted_s is not None and now_s - self.refuted_s >= patience_s


class Schedule:
    """Looks at every twin now and then."""

    def __init__(
        self,
        database: Database,
        registry: Registry,
        jobs: Jobs,
        every_s: float | None,
        patience_s: float,
        refutation_rate: float,
        evidence: Callable[[Entry], float | None],
        ownership: Ownership,
    ) -> None:
        """Begin to look; ``every_s`` None, ``patience_s`` 0 and ``refutation_rate`` 0 switch the triggers off.

        ``evidence`` returns the greatest log evidence against the active model of a twin, None where it has none.
        """
        self._database, self._registry, self._jobs = database, registry, jobs
        self._every_s, self._patience_s = every_s, patience_s
        self._refutation_rate, self._evidence = refutation_rate, evidence
        self._ownership = ownership
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
            refuted = self._refuted()
            try:
                duties = await self._database.read(fleet.duties)
            except Refusal as error:
                log.info("nobody looks for work", extra={"reason": error.detail})
                continue
            for twin in self._registry:
                if twin.key not in duties or not self._ownership.owns(twin.key):
                    self._watches.pop(twin.key, None)
                    continue
                try:
                    await self._look(twin, duties[twin.key], time.monotonic(), twin.key in refuted)
                except Refusal as error:
                    log.info("no recalibration", extra={"twin": twin.name, "reason": error.detail})

    def _refuted(self) -> set[int]:
        """Return the twins whose models fall together at the false discovery rate, whenever one looks."""
        most = {twin.key: value for twin in self._registry if (value := self._evidence(twin)) is not None}
        fallen = discoveries([adjusted(value) for value in most.values()], self._refutation_rate)
        return {key for key, is_fallen in zip(most, fallen, strict=True) if is_fallen}

    async def _look(self, twin: Entry, head: Duty, now_s: float, is_refuted: bool) -> None:
        watch = self._watches.setdefault(twin.key, Watch(now_s, 0))
        triggers = []
        if watch.due_by_schedule(now_s, self._every_s, head.samples):
            triggers.append("schedule")
        if watch.due_by_anomaly(now_s, self._patience_s, head.open_ids):
            triggers.append("anomaly")
        if triggers and head.samples >= LEAST_SAMPLES and not await self._jobs.busy(twin):
            watch.calibrated_s, watch.samples = now_s, head.samples
            request = CalibrationRequest().model_dump(mode="json") | {"trigger": triggers[-1]}
            await self._start(twin, "calibration", request)
        if watch.due_by_refutation(now_s, self._patience_s, is_refuted) and not await self._jobs.busy(twin):
            watch.refuted_s = None
            if not await self._database.read(jobs.asked_since_activation, twin.key, "diagnosis"):
                request = DiagnosisRequest().model_dump(mode="json") | {"trigger": "refuted"}
                await self._start(twin, "diagnosis", request)

    async def _start(self, twin: Entry, kind: str, request: dict[str, Any]) -> None:
        """Start a job that nobody asked for, and put that on record."""
        row = await self._jobs.start(twin, kind, request)
        who = f"the service ({request['trigger']})"
        line = (who, "POST", f"/v1/twins/{twin.name}/{kind}", 202, "", f"job {row.id}")
        await self._database.write(audit.append, now_us(), *line)
