"""Telemetry: take samples in, give the archive out."""

import asyncio
from typing import Annotated, Any

import numpy as np
import orjson
from fastapi import APIRouter, Query, Request, Response
from starlette.routing import Route

from service.access import Role
from service.deps import NamedTwin, Running, Service, TwinName, reads, refuse_unknown, require
from service.downsample import extremes
from service.frames import parse_columns, parse_frames
from service.instants import format_instant, format_instants, parse_parameter
from service.problems import BadField, Problem
from service.registry import Entry
from service.schemas import Archive, IngestReport, Posted
from service.store import samples
from service.store.merge import ACCEPTED, CONFLICT, DUPLICATE
from service.store.samples import Receipt, Samples

PREFIX = "/v1/twins/{twin}/telemetry"
router = APIRouter(prefix=PREFIX, tags=["telemetry"])

NDJSON = "application/x-ndjson"
PARSE_APART_BYTES = 512 * 1024
"""Larger bodies are parsed in a thread, so that other requests are answered meanwhile."""
MOST_POINTS = 200_000

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
    entry = service.registry.get(twin)
    body = (await request.receive()).get("body", b"")  # whole: see Bodies
    parse = _parser(request.headers.get("content-type", ""))
    if len(body) > PARSE_APART_BYTES:
        batch = await asyncio.to_thread(parse, body, entry.units)
    else:
        batch = parse(body, entry.units)
    entry.refuse_implausible(batch.values)
    receipt = await service.intake.store(entry, batch)
    return Response(orjson.dumps(_report(receipt)), media_type="application/json")


(ingesting,) = (route for route in router.routes if isinstance(route, Route))
"""The route of ``ingest``, for a way past the framework."""


def _parser(content_type: str) -> Any:
    media = content_type.partition(";")[0].strip().lower()
    if media == "application/json":
        return parse_columns
    if media in (NDJSON, "application/ndjson", "application/jsonl"):
        return parse_frames
    raise Problem(415, f"content-type must be application/json or {NDJSON}, got '{media[:60]}'")


def _report(receipt: Receipt) -> dict[str, Any]:
    counts = receipt.counts
    conflicts = receipt.conflicts if counts[CONFLICT] else []
    return {
        "accepted": counts[ACCEPTED],
        "duplicates": counts[DUPLICATE],
        "rejected": [{"index": index, "reason": "conflict"} for index in conflicts],
        "last_time": None if receipt.last_us is None else format_instant(receipt.last_us),
    }


@router.get("", dependencies=[reads], response_model=Archive)
async def archive(
    service: Running,
    twin: NamedTwin,
    start: Annotated[str | None, Query(description="First instant, RFC 3339 or unix seconds.")] = None,
    stop: Annotated[str | None, Query(description="First instant after the last one wanted.")] = None,
    channels: Annotated[str | None, Query(description="Channels separated by commas; absent: all.")] = None,
    max_points: Annotated[int, Query(ge=2, le=MOST_POINTS, description="Most samples in the answer.")] = MOST_POINTS,
) -> Response:
    """Return start <= time < stop as columns; beyond ``max_points`` only samples that hold extremes."""
    names = _named(channels, twin)
    start_us, stop_us = span(start, stop)
    rows = [twin.channels.index(name) for name in names]
    found, count = await service.database.read(
        samples.overview, twin.key, len(twin.channels), rows, start_us, stop_us, max_points
    )
    document = await asyncio.to_thread(_render, found, count, names, twin, max_points)
    return Response(document, media_type="application/json")


def span(start: str | None, stop: str | None) -> tuple[int | None, int | None]:
    """Return the instants of an interval in microseconds; BadField if it is empty."""
    start_us = None if start is None else parse_parameter(start, "start")
    stop_us = None if stop is None else parse_parameter(stop, "stop")
    if start_us is not None and stop_us is not None and start_us > stop_us:
        raise BadField("stop", "comes before start")
    return start_us, stop_us


def _named(channels: str | None, twin: Entry) -> list[str]:
    if channels is None:
        return list(twin.channels)
    names = list(dict.fromkeys(name.strip() for name in channels.split(",")))
    for name in names:
        if name not in twin.channels:
            raise BadField("channels", f"unknown channel '{name}' (known: {', '.join(twin.channels)})")
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
