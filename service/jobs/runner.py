"""Runs calibrations and diagnoses: queue, progress, cancel, outcome."""

import asyncio
import logging
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.errors import Refusal
from service.http.problems import Problem
from service.instants import parse_instant
from service.jobs import outcome
from service.jobs.executor import Cancel, JobCancelled, JobFailed, ProcessPerTask
from service.jobs.outcome import Finished
from service.metrics import Metrics
from service.registry import Entry
from service.store import jobs, models, selection
from service.store.database import Database
from service.store.jobs import JobRow
from service.store.models import Active
from service.store.samples import Samples
from service.store.selection import Selection
from service.streams import Hub
from service.workbench import CalibrationTask, DiagnosisTask, MakeWorkbench, Telemetry, work
from twin_core import __version__
from twin_core.telemetry import GAP_STEPS

log = logging.getLogger("service.jobs")

REPORT_EVERY_S = 0.3
VALIDATION_SHARE = 0.2
"""Share of the time span, at its end, that a calibration holds back to score itself and its rival."""
LEAST_VALIDATION = 20
LEAST_SAMPLES = 20
MOST_WAITING = 16
"""Most jobs of one twin that may be queued or running."""

Json = dict[str, Any]


@dataclass
class _Running:
    """A job that has not ended."""

    twin: int
    cancel: Cancel
    task: "asyncio.Task[None] | None" = None


class Jobs:
    """The jobs of this service."""

    def __init__(
        self,
        database: Database,
        hub: Hub,
        metrics: Metrics,
        workbench: MakeWorkbench,
        executor: ProcessPerTask,
        workers: int,
        job_values: int,
        on_model: Callable[[int], None],
    ) -> None:
        """Run at most ``workers`` jobs at a time in an executor; a job takes ``job_values`` values unless asked for more.

        ``on_model`` hears of every twin whose active model changed.
        """
        self._database, self._hub, self._metrics = database, hub, metrics
        self._workbench, self._on_model = workbench, on_model
        self._executor, self._job_values = executor, job_values
        self._free = asyncio.Semaphore(workers)
        self._running: dict[str, _Running] = {}

    async def start(self, twin: Entry, kind: str, request: Json) -> JobRow:
        """Queue a job and return it; Problem 429 if too many wait already."""
        if sum(running.twin == twin.key for running in self._running.values()) >= MOST_WAITING:
            raise Problem(429, f"{MOST_WAITING} jobs of '{twin.name}' have not ended yet; wait for them or cancel some")
        job = uuid.uuid4().hex[:12]
        row = await self._database.write_to(twin.key, jobs.create, twin.key, job, kind, request)
        running = _Running(twin.key, Cancel())
        self._running[job] = running
        running.task = asyncio.create_task(self._run(twin, row, request, running.cancel))
        return row

    async def cancel(self, twin: Entry, kind: str, job: str) -> JobRow:
        """End a job and return it; a job that has ended stays as it is."""
        row = await self._database.read(jobs.get, twin.key, kind, job)
        running = self._running.get(job)
        if running is not None and running.task is not None:
            running.cancel.request()
            await asyncio.wait([running.task])
            row = await self._database.read(jobs.get, twin.key, kind, job)
        return row

    async def cancel_twin(self, twin: Entry) -> None:
        """End every job of a twin that is about to go."""
        for kind in ("calibration", "diagnosis"):
            for row in await self._database.read(jobs.select, twin.key, kind):
                if row.state in ("queued", "running"):
                    await self.cancel(twin, kind, row.id)

    def busy(self, twin: Entry) -> bool:
        """Return whether a job of this twin is queued or running."""
        return any(running.twin == twin.key for running in self._running.values())

    async def close(self) -> None:
        """End every job; each is marked as it ends."""
        for running in self._running.values():
            running.cancel.request()
        tasks = [running.task for running in self._running.values() if running.task is not None]
        if tasks:
            await asyncio.wait(tasks)
        await asyncio.to_thread(self._executor.shutdown)

    async def _run(self, twin: Entry, row: JobRow, request: Json, cancel: Cancel) -> None:
        state, message = "failed", ""
        try:
            await self._wait_for_turn(cancel)
            try:
                self._metrics.jobs_running.inc()
                await self._work(twin, row, request, cancel)
                state = "succeeded"
            finally:
                self._metrics.jobs_running.dec()
                self._free.release()
        except JobCancelled:
            state, message = "cancelled", "cancelled"
        except (JobFailed, Refusal) as error:
            message = error.detail if isinstance(error, Refusal) else str(error)
            if isinstance(error, JobFailed) and error.trace is not None:
                log.error("a job met a defect", extra={"job": row.id, "kind": row.kind, "trace": error.trace})
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            log.exception("a job failed unexpectedly", extra={"job": row.id, "kind": row.kind})
        finally:
            self._running.pop(row.id, None)
        self._metrics.jobs.labels(row.kind, state).inc()
        if state != "succeeded":
            await self._end(twin, row, state, message)

    async def _wait_for_turn(self, cancel: Cancel) -> None:
        """Return once a worker is free."""
        while True:
            if cancel.requested:
                raise JobCancelled
            try:
                async with asyncio.timeout(0.1):
                    await self._free.acquire()
                    return
            except TimeoutError:
                continue

    async def _end(self, twin: Entry, row: JobRow, state: str, message: str) -> None:
        change = (jobs.finish, row.id, state, message)
        try:
            await self._hub.write(twin.key, outcome.announce, twin.key, row.kind, row.id, *change)
        except (LookupError, Refusal):
            log.info("a job ended after its twin was deleted", extra={"job": row.id})

    async def _work(self, twin: Entry, row: JobRow, request: Json, cancel: Cancel) -> None:
        """Do a job whose turn it is."""
        await self._hub.write(twin.key, outcome.announce, twin.key, row.kind, row.id, jobs.begin, row.id)
        chosen = await self.choose(twin, request)
        if chosen.words:
            change = (jobs.report, row.id, 0.0, f"takes {chosen.words}")
            await self._hub.write(twin.key, outcome.announce, twin.key, row.kind, row.id, *change)
        telemetry = _telemetry(twin, chosen.samples)
        active = await self._database.read(models.active, twin.key)
        task, function = self._task(twin, row.kind, request, telemetry, active)
        progress = self._reporter(twin, row)
        future = self._executor.start(work, (self._workbench, function, task), {}, progress, cancel)
        made = await asyncio.wrap_future(future)
        provenance = {
            "data_sha256": telemetry.sha256(),
            "settings": request,
            "telemetry": chosen.wire(),
            "code_version": __version__,
            "epoch_us": telemetry.epoch_us,
            "parent": None if active is None else active.version,
        }
        rival = None if active is None else active.version
        finished = Finished(row.id, row.kind, made, provenance, rival, _wish(row, request), chosen.words)
        if await self._hub.write(twin.key, outcome.save, twin.key, finished) is not None:
            self._on_model(twin.key)

    def _task(
        self, twin: Entry, kind: str, request: Json, telemetry: Telemetry, active: Active | None
    ) -> tuple[CalibrationTask | DiagnosisTask, str]:
        if kind == "diagnosis":
            options = {name: request[name] for name in ("holdout", "burn_in_s", "false_alarm_rate")}
            return DiagnosisTask(twin.specification, telemetry, **options), "diagnose"
        rival = None if active is None else active.parsed()
        cut = validation_start(telemetry, None if active is None else active.train_stop_us)
        return CalibrationTask(twin.specification, telemetry, cut, request["method"], rival), "calibrate"

    async def choose(self, twin: Entry, request: Json) -> Selection:
        """Return the part of the archive that a request names; Problem 422 if it holds too little."""
        start_us, stop_us = (
            None if (at := request.get(n)) is None else parse_instant(at, n) for n in ("start", "stop")
        )
        n, spec = len(twin.channels), twin.spec
        most = request.get("samples") or max(self._job_values // n, LEAST_SAMPLES)
        sensors = [twin.channels.index(name) for name in twin.sensors]
        averaged = [
            row
            for row, name in enumerate(twin.channels)
            if spec.channels[name].kind == "power" and spec.channels[name].is_held
        ]
        how = (start_us, stop_us, most, bool(request.get("thin")), sensors, averaged)
        chosen = await self._database.read(selection.choose, twin.key, n, *how)
        if chosen.samples.time_us.size < LEAST_SAMPLES:
            held = chosen.samples.time_us.size
            raise Problem(422, f"the archive holds {held} samples there, {LEAST_SAMPLES} are needed")
        return chosen

    def _reporter(self, twin: Entry, row: JobRow) -> Callable[[float, str], None]:
        """Return a progress callback for worker threads that writes now and then."""
        last_s = 0.0

        def report(fraction: float, message: str) -> None:
            nonlocal last_s
            now_s = time.monotonic()
            if now_s - last_s >= REPORT_EVERY_S or fraction >= 1.0:
                last_s = now_s
                change = (jobs.report, row.id, min(max(fraction, 0.0), 1.0), message)
                self._hub.submit(twin.key, outcome.announce, twin.key, row.kind, row.id, *change)

        return report


def _telemetry(twin: Entry, found: Samples) -> Telemetry:
    """Return samples for a worker, without channels of which they hold nothing."""
    values = {name: np.ascontiguousarray(found.values[i]) for i, name in enumerate(twin.channels)}
    present = {name: column for name, column in values.items() if np.isfinite(column).any()}
    return Telemetry(int(found.time_us[0]), found.time_us, present)


def _wish(row: JobRow, request: Json) -> bool | None:
    """Return whether the caller wants the new model active: True, False, or None for 'if it is the better one'."""
    wish = request["activate"]
    if row.kind == "diagnosis":
        return bool(wish)
    return None if wish is None else bool(wish)


def validation_start(telemetry: Telemetry, active_stop_us: int | None) -> int:
    """Return where the data begin that neither the new model nor the active one may have been fitted to.

    That is the last fifth of the time that the samples cover, long gaps not counted, or what came after the active
    model's training data if that is shorter; the end of the archive if too few samples would be left to score or to train on.
    """
    last, intervals = int(telemetry.time_us[-1]), np.diff(telemetry.time_us)
    usual = np.where(intervals > GAP_STEPS * np.median(intervals), 0, intervals)
    covered = np.concatenate([[0], np.cumsum(usual)])
    cut = int(telemetry.time_us[np.searchsorted(covered, (1.0 - VALIDATION_SHARE) * covered[-1])])
    if active_stop_us is not None:
        cut = max(cut, active_stop_us + 1)
    position = int(np.searchsorted(telemetry.time_us, cut))
    if telemetry.time_us.size - position < LEAST_VALIDATION or position < LEAST_SAMPLES:
        return last + 1
    return cut
