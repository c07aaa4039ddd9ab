"""Telemetry: take samples in, give the archive out."""

import asyncio
import logging
from collections.abc import Callable
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
import orjson
from fastapi import APIRouter, Path, Query, Request, Response
from starlette.responses import StreamingResponse

from service.archive import changes, export
from service.archive.downsample import extremes
from service.errors import BadField, short
from service.http.deps import NamedTwin, Running, Service, TwinName, operates, reads, refuse_unknown, require
from service.http.problems import Problem
from service.http.telemetry_body import Units, parse_columns, parse_frames
from service.instants import format_instant, format_instants, parse_instant, parse_parameter
from service.keys import Role
from service.schemas import Archive, Deletion, DeletionList, IngestReport, Interval, Posted, Quarantine
from service.store import aside, samples
from service.store.appending import Receipt
from service.store.batch import Batch
from service.store.errors import TwinGone
from service.store.merge import ACCEPTED, CONFLICT, DUPLICATE, QUARANTINED
from service.store.samples import Samples
from service.twins.registry import Entry

PREFIX = "/v1/twins/{twin}/telemetry"
router = APIRouter(prefix=PREFIX, tags=["telemetry"])
quarantine = APIRouter(prefix="/v1/twins/{twin}/quarantine", tags=["telemetry"])
log = logging.getLogger("service")

NDJSON = "application/x-ndjson"
PARSE_APART_BYTES = 512 * 1024
"""Larger bodies are parsed in a thread, so that other requests are answered meanwhile."""
MOST_POINTS = 200_000
MOST_SHOWN = 1000
USUAL_VALUES = 200_000
"""In an answer to which nobody set a bound: a few megabytes."""
AHEAD = "ahead of the receive clock"
"""Why a sample is in quarantine."""

Points = Annotated[
    int | None,
    Query(
        ge=2, le=MOST_POINTS, description="Most samples in the answer; absent: so many that it holds 200,000 values."
    ),
]

_FRAME = {"type": "string", "description": 'One {"time": ..., "values": {...}} per line.'}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/json": {"schema": Posted.model_json_schema()}, NDJSON: {"schema": _FRAME}},
    }
}


@router.post("", response_model=IngestReport, openapi_extra=_BODY)
async def ingest(request: Request, twin: TwinName) -> Response:
    """Store samples durably, then answer what became of each; a malformed body is refused whole."""
    require(request, Role.ingest)
    refuse_unknown(request)
    service: Service = request.app.state.service
    await service.find(twin)
    body = (await request.receive()).get("body", b"")  # whole: see Bodies
    media = request.headers.get("content-type", "")
    parse = parser_of(media)
    if parse is None:
        told = media.partition(";")[0].strip().lower()[:60]
        raise Problem(415, f"content-type must be application/json or {NDJSON}, got '{told}'")
    return Response(await taken(service, twin, parse, body), media_type="application/json")


Parser = Callable[[bytes, Units], Batch]


OUTDATED = (BadField, TwinGone)
"""What goes wrong where another process has given a twin channels, or put another one in its place."""


async def taken(service: Service, twin: str, parse: Parser, body: bytes) -> bytes:
    """Store what a body holds, all of it or nothing, and return the answer: what became of each sample."""
    entry = await service.find(twin)
    try:
        return await _take(service, entry, body, parse)
    except OUTDATED:
        now = await service.find_now(twin)
        if now is entry:
            raise
    return await _take(service, now, body, parse)


async def _take(service: Service, entry: Entry, body: bytes, parse: Parser) -> bytes:
    is_large = len(body) > PARSE_APART_BYTES
    batch = await asyncio.to_thread(read, entry, parse, body) if is_large else read(entry, parse, body)
    return report(await service.intake.store(entry, batch))


def read(entry: Entry, parse: Parser, body: bytes) -> Batch:
    """Return the samples of a body; BadField or Problem if any of it is malformed or cannot be true."""
    batch = parse(body, entry.units)
    entry.refuse_implausible(batch.values)
    return batch


@lru_cache(maxsize=64)
def parser_of(content_type: str) -> Parser | None:
    """Return what reads bodies of a type, None if nothing does."""
    media = content_type.partition(";")[0].strip().lower()
    if media == "application/json":
        return parse_columns
    return parse_frames if media in (NDJSON, "application/ndjson", "application/jsonl") else None


def report(receipt: Receipt) -> bytes:
    """Return the answer that tells what became of each sample."""
    return orjson.dumps(told_of(receipt))


def told_of(receipt: Receipt) -> dict[str, Any]:
    """Return what became of each sample."""
    counts = receipt.counts
    conflicts = receipt.conflicts if counts[CONFLICT] else []
    told = {
        "accepted": counts[ACCEPTED],
        "duplicates": counts[DUPLICATE],
        "rejected": [{"index": index, "reason": "conflict"} for index in conflicts],
        "last_time": None if receipt.last_us is None else format_instant(receipt.last_us),
    }
    if counts[QUARANTINED]:
        told["quarantined"] = [{"index": index, "reason": AHEAD} for index in receipt.quarantined]
    return told


@router.get("", dependencies=[reads], response_model=Archive)
async def archive(
    service: Running,
    twin: NamedTwin,
    start: Annotated[str | None, Query(description="First instant, RFC 3339 or unix seconds.")] = None,
    stop: Annotated[str | None, Query(description="First instant after the last one wanted.")] = None,
    channels: Annotated[str | None, Query(description="Channels separated by commas; absent: all.")] = None,
    max_points: Points = None,
) -> Response:
    """Return start <= time < stop as columns; beyond ``max_points`` only samples that hold extremes."""
    names = named(channels, twin)
    max_points = bounded(max_points, len(names))
    start_us, stop_us = span(start, stop)
    rows = [twin.channels.index(name) for name in names]
    found, count = await service.database.read(
        samples.overview, twin.key, len(twin.channels), rows, start_us, stop_us, max_points
    )
    document = await asyncio.to_thread(_render, found, count, names, twin, max_points)
    return Response(document, media_type="application/json")


@router.get("/export", dependencies=[reads], response_class=StreamingResponse)
async def export_file(
    service: Running,
    twin: NamedTwin,
    format: Annotated[export.Format, Query(description="csv or parquet.")] = "csv",
    start: Annotated[str | None, Query(description="First instant, RFC 3339 or unix seconds.")] = None,
    stop: Annotated[str | None, Query(description="First instant after the last one wanted.")] = None,
    channels: Annotated[str | None, Query(description="Channels separated by commas; absent: all.")] = None,
) -> StreamingResponse:
    """Return every sample of start <= time < stop as a file, however long it gets."""
    pieces = export.stream(service.database, twin, named(channels, twin), *span(start, stop), format)
    headers = {"Content-Disposition": f'attachment; filename="{twin.name}.{format}"'}
    return StreamingResponse(pieces, media_type=export.MEDIA[format], headers=headers)


@router.delete("", dependencies=[operates])
async def delete(
    service: Running,
    twin: NamedTwin,
    start: Annotated[str | None, Query(description="First instant, RFC 3339 or unix seconds.")] = None,
    stop: Annotated[str | None, Query(description="First instant after the last one that goes.")] = None,
    channels: Annotated[str | None, Query(description="Channels separated by commas; absent: whole samples.")] = None,
) -> Deletion:
    """Delete start <= time < stop, or the values of some channels there; it can be undone for a day."""
    if start is None and stop is None and channels is None:
        raise Problem(422, "name at least one of start, stop and channels; to delete everything, delete the twin")
    names = None if channels is None else named(channels, twin)
    made = await service.hub.write(twin.key, changes.delete, twin, *span(start, stop), names)
    if made.samples:
        service.live.archive_changed(twin)
    log.warning("telemetry was deleted", extra={"twin": twin.name, **made.wire()})
    return Deletion(**made.wire())


@router.get("/deletions", dependencies=[reads])
async def list_deletions(service: Running, twin: NamedTwin) -> DeletionList:
    """List what was ever deleted from the archive or the quarantine, the newest first."""
    rows = await service.database.read(aside.deletions, twin.key)
    return DeletionList(deletions=[Deletion(**row.wire()) for row in rows])


@router.post("/deletions/{deletion}/undo", dependencies=[operates])
async def undo(
    service: Running, twin: NamedTwin, deletion: Annotated[int, Path(ge=1, le=2**62, description="Its number.")]
) -> Deletion:
    """Put back what a deletion took, unless it is more than a day old; what was stored there meanwhile stays as it is."""
    made = await service.hub.write(twin.key, changes.undo, twin, deletion)
    service.live.arrived(twin)
    log.warning("a deletion was undone", extra={"twin": twin.name, **made.wire()})
    return Deletion(**made.wire())


@quarantine.get("", dependencies=[reads])
async def list_quarantine(service: Running, twin: NamedTwin) -> Quarantine:
    """Return the samples that lie ahead of the present in the order of their arrival, the first 1000 of them."""
    kept = await service.database.read(aside.quarantined, twin.key)
    found = await service.database.read(aside.select, twin.key, len(twin.channels), MOST_SHOWN)
    return Quarantine(
        samples=kept.samples,
        time=format_instants(found.time_us),
        received=format_instants(found.received),
        values={
            name: [None if v != v else v for v in found.values[row].tolist()] for row, name in enumerate(twin.channels)
        },
    )


@quarantine.post("/release", dependencies=[operates])
async def release(service: Running, twin: NamedTwin, request: Interval | None = None) -> IngestReport:
    """Let samples out of quarantine into the archive, where they move the present: their clock was right."""
    asked = request or Interval()
    start_us, stop_us = (None if t is None else parse_instant(t, n) for n, t in asked)
    receipt = await service.hub.write(twin.key, changes.release, twin, start_us, stop_us)
    service.live.arrived(twin)
    log.warning("samples were let out of quarantine", extra={"twin": twin.name, "n": int(receipt.status.size)})
    return IngestReport(**told_of(receipt))


@quarantine.delete("", dependencies=[operates])
async def discard(
    service: Running,
    twin: NamedTwin,
    start: Annotated[str | None, Query(description="First instant, RFC 3339 or unix seconds.")] = None,
    stop: Annotated[str | None, Query(description="First instant after the last one that goes.")] = None,
    everything: Annotated[bool, Query(alias="all", description="Instead of start and stop: all of it.")] = False,
) -> Deletion:
    """Delete samples in quarantine; it can be undone for a day."""
    if everything == (start is not None or stop is not None):
        raise Problem(422, "name start, stop or both; to delete everything in quarantine, all=true alone")
    made = await service.database.write_to(twin.key, aside.discard, twin.key, len(twin.channels), *span(start, stop))
    log.warning("samples in quarantine were deleted", extra={"twin": twin.name, **made.wire()})
    return Deletion(**made.wire())


def bounded(max_points: int | None, n_columns: int) -> int:
    """Return how many samples an answer of so many columns holds at most."""
    return max_points or max(2, USUAL_VALUES // max(n_columns, 1))


def span(start: str | None, stop: str | None) -> tuple[int | None, int | None]:
    """Return the instants of an interval in microseconds; BadField if it is empty."""
    start_us = None if start is None else parse_parameter(start, "start")
    stop_us = None if stop is None else parse_parameter(stop, "stop")
    if start_us is not None and stop_us is not None and start_us > stop_us:
        raise BadField("stop", "comes before start")
    return start_us, stop_us


def named(channels: str | None, twin: Entry) -> list[str]:
    if channels is None:
        return list(twin.channels)
    names = list(dict.fromkeys(name.strip() for name in channels.split(",")))
    for name in names:
        if name not in twin.channels:
            raise BadField("channels", f"unknown channel '{short(name)}' (known: {', '.join(twin.channels)})")
    return names


def _render(found: Samples, count: int, names: list[str], twin: Entry, max_points: int) -> bytes:
    kept = extremes(found.values, max_points)
    values = found.values[:, kept]
    columns = {name: np.ascontiguousarray(values[row]) for row, name in enumerate(names)}
    document = {
        "time": format_instants(found.time_us[kept]),
        "values": columns,  # orjson writes NaN as null
        "units": {name: twin.units[name] for name in names},
        "samples": count,
        "downsampled": kept.size < count,
    }
    return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
