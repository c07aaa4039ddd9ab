"""What the live state tells: forecasts, residuals, anomalies."""

import asyncio
from typing import Annotated, Any

import numpy as np
import orjson
from fastapi import APIRouter, Query, Response
from numpy.typing import NDArray

from service.archive.downsample import extremes
from service.http.deps import NamedTwin, Running, Service, reads
from service.http.routes.telemetry import Points, bounded, span
from service.instants import format_instant, format_instants
from service.live import forecasts, limits, screening
from service.schemas import Anomaly, AnomalyList, Forecast, ForecastRequest, Inputs, Network, Residuals
from service.store import alarms, anomalies, models, residuals, samples
from service.store.residuals import Residuals as Found
from service.twins.fit import lacks
from service.twins.registry import Entry

router = APIRouter(prefix="/v1/twins/{twin}", tags=["live state"])

Start = Annotated[str | None, Query(description="First instant, RFC 3339 or unix seconds.")]
Stop = Annotated[str | None, Query(description="First instant after the last one wanted.")]
Version = Annotated[int | None, Query(ge=1, le=2**62, description="Of the model; absent: the active one.")]
Spans = dict[str, list[dict[str, Any]]]
MOST_SCREENED = 100_000
"""Longer answers do not say what was masked: ask for a part."""
Seconds = Annotated[float, Query(gt=0, allow_inf_nan=False)]
SecondsOrNone = Annotated[float | None, Query(gt=0, allow_inf_nan=False)]


@router.post("/forecasts", dependencies=[reads], response_model=Forecast)
async def forecast(service: Running, twin: NamedTwin, request: ForecastRequest) -> Response:
    """Look ahead from the assimilated state with planned inputs; the answer says what was assumed of the others."""
    return await _forecast(service, twin, request)


@router.get("/forecast", dependencies=[reads], response_model=Forecast)
async def forecast_as_is(
    service: Running, twin: NamedTwin, horizon_s: Seconds, step_s: SecondsOrNone = None, inputs: Inputs = "auto"
) -> Response:
    """Look ahead from the assimilated state without a plan: inputs repeat or hold, as the answer says."""
    return await _forecast(service, twin, ForecastRequest(horizon_s=horizon_s, step_s=step_s, inputs=inputs))


async def _forecast(service: Service, twin: Entry, request: ForecastRequest) -> Response:
    tracker = service.live.state(twin)
    ahead = forecasts.look_ahead(tracker, service.database, service.live.engine, request)
    version = None if tracker.active is None else tracker.active.version
    lasting = service.database.read(anomalies.open_kinds, twin.key, version)
    alarmed = service.database.read(alarms.lasting, twin.key)
    look, beats, kinds, rows = await asyncio.gather(ahead, service.live.beats(twin), lasting, alarmed)
    silent_s = forecasts.silence_s(twin, beats)
    expected = list(limits.expected(twin, look.position.time_us, look.made, {row.limit for row in rows}))
    document = forecasts.render(twin, look, request.quantiles, expected)
    document["notices"] += forecasts.notices(tracker, look.position, look.lag, silent_s)
    document["notices"] += forecasts.ahead_of_clock(twin, look.position)
    document["notices"] += forecasts.delays(twin, look.position, beats)
    document["notices"] += forecasts.unheard(look, beats)
    document["notices"] += forecasts.doubts(twin, kinds)
    if missing := lacks(look.active.specification, twin.specification):
        what = ", ".join(missing[:5]) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        document["notices"].append(
            f"model version {look.active.version} was made for another revision of the specification: {what}; recalibrate"
        )
    return Response(orjson.dumps(document), media_type="application/json")


@router.get("/network", dependencies=[reads])
async def network(service: Running, twin: NamedTwin) -> Network:
    """Return temperatures of all nodes, the unsensed ones too, and every heat flow between them, as they are now."""
    active, position = await forecasts.state_of(service.live.state(twin))
    telemetry = forecasts.moment(twin, active, position)
    flows = await service.live.engine.flows(active.document, telemetry, position.state)
    return Network(model_version=active.version, time=format_instant(position.time_us), **flows)


@router.get("/residuals", dependencies=[reads], response_model=Residuals)
async def list_residuals(
    service: Running,
    twin: NamedTwin,
    start: Start = None,
    stop: Stop = None,
    version: Version = None,
    max_points: Points = None,
    predicted: Annotated[bool, Query(description="Whether to add what was predicted, in the channels' units.")] = False,
) -> Response:
    """Return innovations, their predicted standard deviations and the NIS, and which samples are no readings, and why."""
    start_us, stop_us = span(start, stop)
    max_points = bounded(max_points, 2 * len(twin.sensors) + 1)
    if version is not None:
        await service.database.read(models.get, twin.key, version)
    tracker = service.live.state(twin)
    complete = await tracker.settled(forecasts.SETTLE_S)
    chosen = version or (tracker.active.version if tracker.active is not None else 0)
    n_sensors = len(twin.sensors)
    found, count = await service.database.read(
        residuals.overview, twin.key, chosen, n_sensors, start_us, stop_us, max_points
    )
    masked, raw = None, None
    if count <= MOST_SCREENED:
        masked = await _masked(service, twin, found)
        if predicted and count:
            n, span_us = len(twin.channels), (int(found.time_us[0]), int(found.time_us[-1]) + 1)
            raw = await service.database.read(samples.select, twin.key, n, range(n), *span_us)
    document = await asyncio.to_thread(_render, twin, found, count, max_points, masked, raw, complete)
    return Response(document, media_type="application/json")


async def _masked(service: Service, twin: Entry, found: Found) -> Spans:
    """Return which of the sensors' samples that residuals belong to are no readings."""
    if not found.time_us.size:
        return {}
    first_us, last_us = int(found.time_us[0]), int(found.time_us[-1])
    usual_us = int(np.median(np.diff(found.time_us))) if found.time_us.size > 1 else 60_000_000
    n, span_us = len(twin.channels), (first_us - screening.CONTEXT * usual_us, last_us + 1)
    raw = await service.database.read(samples.select, twin.key, n, range(n), *span_us)
    masks = await screening.masks_of(twin, service.live.engine, raw)
    return screening.told(raw, masks, twin.sensors, first_us)


def _render(
    twin: Entry,
    found: Found,
    count: int,
    max_points: int,
    masked: Spans | None,
    raw: samples.Samples | None,
    complete: bool,
) -> bytes:
    kept = extremes(np.vstack([found.innovation_K, found.nis[None, :]]), max_points)

    def columns(matrix: Any) -> dict[str, Any]:
        return {name: np.ascontiguousarray(matrix[row, kept]) for row, name in enumerate(twin.sensors)}

    document = {
        "time": format_instants(found.time_us[kept]),
        "residual_K": columns(found.innovation_K),
        "std_K": columns(found.innovation_std_K),
        "nis": np.ascontiguousarray(found.nis[kept]),
        "model_version": [found.version] * int(kept.size),
        "masked": masked,
        "samples": count,
        "downsampled": kept.size < count,
        "complete": complete,
    }
    if raw is not None:
        document["predicted"] = _predicted(twin, found, kept, raw)
    return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)


def _predicted(
    twin: Entry, found: Found, kept: NDArray[np.int64], raw: samples.Samples
) -> dict[str, NDArray[np.float64]]:
    """Return what was predicted one sample ahead, in the channels' units: a reading less its innovation."""
    place = np.minimum(np.searchsorted(raw.time_us, found.time_us[kept]), raw.time_us.size - 1)
    there = raw.time_us[place] == found.time_us[kept]
    measured = {name: raw.values[twin.channels.index(name), place] for name in twin.sensors}
    return {
        name: np.where(there, measured[name] - found.innovation_K[row, kept], np.nan)
        for row, name in enumerate(twin.sensors)
    }


@router.get("/anomalies", dependencies=[reads])
async def list_anomalies(
    service: Running, twin: NamedTwin, start: Start = None, stop: Stop = None, version: Version = None
) -> AnomalyList:
    """List the intervals in which a sensor did not behave as its model, the newest first."""
    if version is not None:
        await service.database.read(models.get, twin.key, version)
    rows = await service.database.read(anomalies.select, twin.key, *span(start, stop), version)
    return AnomalyList(anomalies=[Anomaly(**row.wire()) for row in rows])
