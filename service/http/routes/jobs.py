"""Calibrations and diagnoses: start, look, cancel."""

import asyncio
import importlib
from typing import Any

from fastapi import APIRouter, Response
from starlette.responses import HTMLResponse

from service.errors import BadField, short
from service.http.deps import NamedTwin, Note, Running, Service, operates, reads
from service.http.problems import Problem
from service.instants import format_instant, parse_instant
from service.jobs.runner import LEAST_SAMPLES
from service.schemas import CalibrationRequest, DiagnosisRequest, Job, JobKind, JobList
from service.store import jobs, twins
from service.twins.registry import Entry

PAGE_POLICY = "default-src 'none'; img-src data:; font-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


async def _start(
    service: Service, twin: Entry, kind: JobKind, request: dict[str, Any], response: Response, note: Note
) -> Job:
    start, stop = (None if request[n] is None else parse_instant(request[n], n) for n in ("start", "stop"))
    if start is not None and stop is not None and start >= stop:
        raise BadField("stop", "must come after start")
    most_s = service.settings.job_deadline_s
    if request["deadline_s"] is not None and request["deadline_s"] > most_s:
        raise BadField("deadline_s", f"a job is ended after {most_s:g} s (TWIN_JOB_DEADLINE_S)")
    head = await service.database.read(twins.get, twin.name)
    if head.samples < LEAST_SAMPLES:
        raise Problem(
            422, f"the archive holds {head.samples} samples, {LEAST_SAMPLES} are needed; send telemetry first"
        )
    if start is not None and head.last_us is not None and start > head.last_us:
        raise BadField("start", f"comes after the last sample ({format_instant(head.last_us)})")
    if stop is not None and head.first_us is not None and stop <= head.first_us:
        raise BadField("stop", f"does not come after the first sample ({format_instant(head.first_us)})")
    row = await service.jobs.start(twin, kind, request)
    note(f"{kind} {row.id}")
    rooms = {"calibration": "calibrations", "diagnosis": "diagnoses"}
    response.headers["Location"] = f"/v1/twins/{twin.name}/{rooms[kind]}/{row.id}"
    return Job(**row.wire())


def _looking(kind: JobKind, router: APIRouter) -> None:
    """Add the routes that calibrations and diagnoses have in common."""

    @router.get("", dependencies=[reads], summary=f"List every {kind}, the newest first")
    async def list_jobs(service: Running, twin: NamedTwin) -> JobList:
        """Return the jobs of one kind."""
        rows = await service.database.read(jobs.select, twin.key, kind)
        return JobList(jobs=[Job(**row.wire()) for row in rows])

    @router.get("/{job}", dependencies=[reads], summary=f"Look at one {kind}")
    async def inspect(service: Running, twin: NamedTwin, job: str) -> Job:
        """Return state, progress and result."""
        row = await service.database.read(jobs.get, twin.key, kind, job)
        return Job(**row.wire())

    @router.delete("/{job}", dependencies=[operates], summary=f"Cancel a {kind}; one that has ended stays as it is")
    async def cancel(service: Running, twin: NamedTwin, job: str) -> Job:
        """End the process of a job that runs; return the job as it stands then."""
        row = await service.jobs.cancel(twin, kind, job)
        return Job(**row.wire())


calibrations = APIRouter(prefix="/v1/twins/{twin}/calibrations", tags=["calibrations"])
diagnoses = APIRouter(prefix="/v1/twins/{twin}/diagnoses", tags=["diagnoses"])


async def _check_method(method: str) -> None:
    """Refuse unknown methods; only a request for an unusual one makes the server look up which there are."""
    if method == CalibrationRequest().method:
        return
    module = await asyncio.to_thread(importlib.import_module, "twin_core.calibrate")
    if method not in module.METHODS:
        raise BadField("method", f"unknown method '{short(method)}' (known: {', '.join(module.METHODS)})")


@calibrations.post("", status_code=202, dependencies=[operates])
async def calibrate(
    service: Running, twin: NamedTwin, response: Response, note: Note, request: CalibrationRequest | None = None
) -> Job:
    """Recalibrate in the background; the new version becomes active if it is the first or the better one."""
    request = request or CalibrationRequest()
    await _check_method(request.method)
    return await _start(service, twin, "calibration", request.model_dump(mode="json"), response, note)


@diagnoses.post("", status_code=202, dependencies=[operates])
async def diagnose(
    service: Running, twin: NamedTwin, response: Response, note: Note, request: DiagnosisRequest | None = None
) -> Job:
    """Close the loop on the archive: find what the model lacks, and score it on held-out telemetry."""
    settings = (request or DiagnosisRequest()).model_dump(mode="json")
    return await _start(service, twin, "diagnosis", settings, response, note)


@diagnoses.get("/{job}/report.html", dependencies=[reads], response_class=HTMLResponse)
async def report(service: Running, twin: NamedTwin, job: str) -> HTMLResponse:
    """Return the report as a page."""
    page = await service.database.read(jobs.page, twin.key, "diagnosis", job)
    if page is None:
        raise Problem(404, f"diagnosis '{job}' has no report; look at its state")
    return HTMLResponse(page, headers={"Content-Security-Policy": PAGE_POLICY})


for _kind, _router in (("calibration", calibrations), ("diagnosis", diagnoses)):
    _looking(_kind, _router)  # type: ignore[arg-type]
