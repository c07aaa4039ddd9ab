"""Runs calibrations and diagnoses: queue, progress, cancel, outcome."""

import asyncio
import contextlib
import logging
import os
import socket
import time
import uuid
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import Refusal, TooLittle, TooMuch
from service.instants import parse_instant
from service.jobs import outcome
from service.jobs.executor import Cancel, ExecutorLost, JobCancelled, JobFailed, Task, Tasks
from service.jobs.outcome import Finished
from service.monitoring.metrics import Metrics
from service.store import anomalies, jobs, models, selection
from service.store.database import Database
from service.store.errors import LeaseLost
from service.store.jobs import Claim, JobRow
from service.store.models import Active
from service.store.samples import Samples
from service.store.selection import Selection
from service.stream.hub import Hub
from service.twins.registry import Entry
from service.workbench.interface import CalibrationTask, DiagnosisTask, MakeWorkbench, Telemetry, work
from twin_core import __version__
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import GAP_STEPS

log = logging.getLogger("service.jobs")

REPORT_EVERY_S, REPORTS_AT_ONCE = 0.3, 50
"""How often a job's progress is written in the long run, and how many times at once: after short phases a long one may follow,
whose words are seldom lost so."""

VALIDATION_SHARE = 0.2
"""Share of the time span, at its end, that a calibration holds back to score itself and its rival."""
HOLDOUT_SHARE = 0.3
"""The same of a diagnosis."""
LEAST_VALIDATION = 20
LEAST_SAMPLES = 20
MOST_DERIVATIVES = 20_000_000
"""So many derivatives of readings by parameters a job works with unless asked for more; a fit holds some copies, 160 MB each."""
MOST_WAITING = 16
"""Most jobs of one twin that may be queued or running."""
LEASE_S, BEAT_S = 20.0, 4.0
"""A worker says that it lives every BEAT_S; one that has not for LEASE_S is taken for dead."""
LOOK_EVERY_S = 1.0
"""How often an idle worker looks for jobs that others queued."""
MOST_ATTEMPTS = 3
"""A job of which so many workers died is not tried again."""
CANCEL_S = 15.0
"""How long a request to cancel waits for a worker elsewhere."""

Json = dict[str, Any]


@dataclass
class _Running:
    """A job that this process does."""

    held: Claim
    cancel: Cancel
    task: "asyncio.Task[None] | None" = None


def usual_samples(spec: TwinSpec, values: int) -> int:
    """Return how many samples a job takes unless asked: of at most so many values, fewer of a network that is wide."""
    per_sample = len(spec.sensors) * (len(spec.nodes) + len(spec.conductors))
    return max(min(values // len(spec.channels), MOST_DERIVATIVES // max(per_sample, 1)), LEAST_SAMPLES)


class Jobs:
    """The jobs of all twins, those of them that this process does, and the queue from which it takes them."""

    def __init__(
        self,
        database: Database,
        hub: Hub,
        metrics: Metrics,
        workbench: MakeWorkbench,
        executor: Tasks,
        workers: int,
        job_values: int,
        search_s: float,
        on_model: Callable[[int], None],
        find: Callable[[int], Awaitable[Entry | None]],
    ) -> None:
        """Do at most ``workers`` jobs at a time in an executor; a job takes ``job_values`` values unless asked for more.

        Its search ends after ``search_s`` unless it is given another deadline.
        ``on_model`` hears of every twin whose active model changed; ``find`` returns a twin by its number.
        """
        self._database, self._hub, self._metrics = database, hub, metrics
        self._workbench, self._on_model, self._find = workbench, on_model, find
        self._executor, self._job_values, self._search_s = executor, job_values, search_s
        self._name = f"{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:6]}"
        self._free = asyncio.Semaphore(workers)
        self._running: dict[str, _Running] = {}
        self._wake = asyncio.Event()
        self._is_closing = False
        self._is_away = False
        self._tasks = [asyncio.create_task(self._claim_forever())] if workers else []
        self._tasks.append(asyncio.create_task(self._beat_forever()))

    async def start(self, twin: Entry, kind: str, request: Json) -> JobRow:
        """Queue a job and return it; TooMuch if too many wait already."""
        if await self._database.read(jobs.waiting, twin.key) >= MOST_WAITING:
            raise TooMuch(f"{MOST_WAITING} jobs of '{twin.name}' have not ended yet; wait for them or cancel some")
        job = uuid.uuid4().hex[:12]
        row = await self._database.write_to(twin.key, jobs.create, twin.key, job, kind, request)
        self._wake.set()
        return row

    async def cancel(self, twin: Entry, kind: str, job: str) -> JobRow:
        """End a job and return it; a job that has ended stays as it is."""
        row = await self._database.read(jobs.get, twin.key, kind, job)
        if row.state == "queued":
            change = (jobs.finish_waiting, job)
            await self._hub.write(twin.key, outcome.announce, twin.key, kind, job, *change)
            row = await self._database.read(jobs.get, twin.key, kind, job)
            if row.state == "cancelled":
                self._metrics.jobs.labels(kind, row.state).inc()
        if row.state == "running" and job not in self._running:
            await self._database.write(jobs.ask_to_cancel, job)
        until_s = time.monotonic() + CANCEL_S
        while row.state == "running" and time.monotonic() < until_s:
            running = self._running.get(job)  # what this process claimed a moment ago stands there a turn later
            if running is not None and running.task is not None:
                running.cancel.request()
                await asyncio.wait([running.task])
            else:
                await asyncio.sleep(0.1)
            row = await self._database.read(jobs.get, twin.key, kind, job)
        return row

    async def cancel_twin(self, twin: Entry) -> None:
        """End every job of a twin that is about to go."""
        for kind in ("calibration", "diagnosis"):
            for row in await self._database.read(jobs.select, twin.key, kind):
                if row.state in ("queued", "running"):
                    await self.cancel(twin, kind, row.id)

    async def busy(self, twin: Entry) -> bool:
        """Return whether a job of this twin is queued or running, wherever."""
        return await self._database.read(jobs.waiting, twin.key) > 0

    async def close(self) -> None:
        """Claim nothing more and end every job of this process; each is marked as it ends, or waits for another one."""
        self._is_closing = True
        for task in self._tasks:
            task.cancel()
        await asyncio.wait(self._tasks)
        for running in self._running.values():
            running.cancel.request()
        tasks = [running.task for running in self._running.values() if running.task is not None]
        if tasks:
            await asyncio.wait(tasks)
        with contextlib.suppress(Refusal):
            await self._database.write(jobs.leave, self._name, is_shared=self._database.is_shared)
        await asyncio.to_thread(self._executor.shutdown)

    async def _claim_forever(self) -> None:
        """Take jobs as long as there are some and a worker is free; then wait for a word, and look now and then."""
        while True:
            await self._free.acquire()
            held = None
            try:
                if await self._is_reached():
                    claiming = (self._name, round(1e6 * LEASE_S))
                    held = await self._database.write(jobs.claim, *claiming, is_shared=self._database.is_shared)
            except Exception as error:  # such as a database that is away: the queue stays as it is
                log.warning("no job can be claimed", extra={"reason": f"{type(error).__name__}: {error}"})
            if held is not None:
                running = self._running[held.job] = _Running(held, Cancel())
                running.task = asyncio.create_task(self._run(running))
                continue
            self._free.release()
            self._wake.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_EVERY_S):
                    await self._wake.wait()

    async def _is_reached(self) -> bool:
        """Return whether what computes is there; the log says once that it is not, and once that it is again."""
        try:
            await asyncio.to_thread(self._executor.reach)
        except ExecutorLost as error:
            if not self._is_away:
                log.error("what computes is away; no job is taken until it is there", extra={"reason": str(error)})
            self._is_away = True
            return False
        if self._is_away:
            log.warning("what computes is there again")
        self._is_away = False
        return True

    async def _beat_forever(self) -> None:
        """Say that this worker lives; let go of jobs that are in other hands, and end those that somebody cancelled."""
        while True:
            await asyncio.sleep(BEAT_S)
            if not self._running or not self._database.is_shared:
                continue
            known = list(self._running.items())
            try:
                held = await self._database.write(jobs.beat, self._name)
            except Exception as error:
                log.warning("no word of the jobs can be sent", extra={"reason": f"{type(error).__name__}: {error}"})
                continue
            for job, running in known:
                attempt, cancel = held.get(job, (-1, True))
                if cancel or attempt != running.held.attempt:
                    running.cancel.request()

    async def _run(self, running: _Running) -> None:
        held, cancel = running.held, running.cancel
        state, message = "failed", ""
        self._metrics.jobs_running.inc()
        try:
            twin = await self._find(held.twin)
            if twin is None:
                raise JobCancelled
            if held.tries > MOST_ATTEMPTS:
                raise JobFailed(f"its worker died {MOST_ATTEMPTS} times; take fewer samples, or look at the log")
            await self._work(twin, held, cancel)
            state = "succeeded"
        except JobCancelled:
            given_up = self._is_closing and self._database.is_shared  # another process goes on with it
            state, message = ("queued", "") if given_up else ("cancelled", "cancelled")
        except LeaseLost:
            state = "lost"
            log.warning("a job is in other hands now", extra={"job": held.job, "attempt": held.attempt})
        except ExecutorLost as error:
            state = "queued"
            log.warning("what computes is away; the job waits", extra={"job": held.job, "reason": str(error)})
        except (JobFailed, Refusal) as error:
            message = error.detail if isinstance(error, Refusal) else str(error)
            if isinstance(error, JobFailed) and error.trace is not None:
                log.error("a job met a defect", extra={"job": held.job, "kind": held.kind, "trace": error.trace})
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            log.exception("a job failed unexpectedly", extra={"job": held.job, "kind": held.kind})
        finally:
            self._running.pop(held.job, None)
            self._metrics.jobs_running.dec()
            self._free.release()
        self._metrics.jobs.labels(held.kind, state).inc()
        if state not in ("succeeded", "lost"):
            await self._end(held, state, message)

    async def _end(self, held: Claim, state: str, message: str) -> None:
        change = (jobs.put_back, held) if state == "queued" else (jobs.end, held, state, message)
        try:
            await self._hub.write(held.twin, outcome.announce, held.twin, held.kind, held.job, *change)
        except (LookupError, Refusal, LeaseLost):
            log.info("a job ended after its twin was deleted, or in other hands", extra={"job": held.job})

    async def _work(self, twin: Entry, held: Claim, cancel: Cancel) -> None:
        """Do a job whose turn it is."""
        request = held.request
        await self._say(held, 0.0, "starting")
        chosen = await self.choose(twin, request)
        if chosen.words:
            await self._say(held, 0.0, f"takes {chosen.words}")
        telemetry = _telemetry(twin, chosen.samples)
        active = await self._database.read(models.active, twin.key)
        family = twin.specification.get("family")
        siblings = {} if family is None else await self._database.read(models.siblings, family, twin.name)
        if held.kind == "diagnosis" and request.get("holdout") is None:
            began_us = await self._database.read(anomalies.open_since, twin.key)
            request = {**request, "holdout": usual_holdout(telemetry.time_us, began_us)}
        task, function = self._task(twin, held.kind, request, telemetry, active, siblings)
        future = self._executor.start(Task(work, (self._workbench, function, task), self._reporter(held), cancel))
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
        wish = _wish(held.kind, request)
        finished = Finished(held.job, held.kind, made, provenance, rival, wish, chosen.words, held)
        if await self._hub.write(twin.key, outcome.save, twin.key, finished) is not None:
            self._on_model(twin.key)

    async def _say(self, held: Claim, progress: float, message: str) -> None:
        change = (jobs.report, held, progress, message)
        await self._hub.write(held.twin, outcome.announce, held.twin, held.kind, held.job, *change)

    def _task(
        self,
        twin: Entry,
        kind: str,
        request: Json,
        telemetry: Telemetry,
        active: Active | None,
        siblings: dict[str, Json],
    ) -> tuple[CalibrationTask | DiagnosisTask, str]:
        deadline_s = request.get("deadline_s") or self._search_s
        if kind == "diagnosis":
            options = {name: request[name] for name in ("holdout", "burn_in_s", "false_alarm_rate")}
            return DiagnosisTask(
                twin.specification, telemetry, **options, deadline_s=deadline_s, siblings=siblings
            ), "diagnose"
        rival = None if active is None else active.parsed()
        cut = validation_start(telemetry, None if active is None else active.train_stop_us)
        task = CalibrationTask(twin.specification, telemetry, cut, request["method"], deadline_s, rival, siblings)
        return task, "calibrate"

    async def choose(self, twin: Entry, request: Json) -> Selection:
        """Return the part of the archive that a request names; TooLittle if it holds too little."""
        start_us, stop_us = (
            None if (at := request.get(n)) is None else parse_instant(at, n) for n in ("start", "stop")
        )
        n, spec = len(twin.channels), twin.spec
        most = request.get("samples") or usual_samples(spec, self._job_values)
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
            raise TooLittle(f"the archive holds {held} samples there, {LEAST_SAMPLES} are needed")
        return chosen

    def _reporter(self, held: Claim) -> Callable[[float, str], None]:
        """Return a progress callback for worker threads that writes now and then, and some times in a row (a token bucket)."""
        last_s, left = time.monotonic(), float(REPORTS_AT_ONCE)

        def report(fraction: float, message: str) -> None:
            nonlocal last_s, left
            now_s = time.monotonic()
            last_s, left = now_s, min(left + (now_s - last_s) / REPORT_EVERY_S, REPORTS_AT_ONCE)
            if left >= 1.0 or fraction >= 1.0:
                left -= 1.0
                change = (jobs.report, held, min(max(fraction, 0.0), 1.0), message)
                self._hub.submit(held.twin, outcome.announce, held.twin, held.kind, held.job, *change)

        return report


def _telemetry(twin: Entry, found: Samples) -> Telemetry:
    """Return samples for a worker, without channels of which they hold nothing."""
    values = {name: np.ascontiguousarray(found.values[i]) for i, name in enumerate(twin.channels)}
    present = {name: column for name, column in values.items() if np.isfinite(column).any()}
    return Telemetry(int(found.time_us[0]), found.time_us, present)


def _wish(kind: str, request: Json) -> bool | None:
    """Return whether the caller wants the new model active: True, False, or None for 'if it is the better one'."""
    wish = request["activate"]
    if kind == "diagnosis":
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


def usual_holdout(time_us: NDArray[np.int64], began_us: Sequence[int]) -> float:
    """Return what share of the time a diagnosis keeps back unless asked: no search finds what it was not shown.

    Where an open anomaly began within the usual share, half of the time since the first of them is searched and half kept back.
    """
    first_us, last_us = int(time_us[0]), int(time_us[-1])
    span_us = last_us - first_us
    fresh = [began for began in began_us if last_us - HOLDOUT_SHARE * span_us < began < last_us]
    if not fresh:
        return HOLDOUT_SHARE
    least_us = last_us - int(time_us[-min(LEAST_VALIDATION, time_us.size // 2)])
    return min(max(0.5 * (last_us - min(fresh)), least_us) / span_us, HOLDOUT_SHARE)
