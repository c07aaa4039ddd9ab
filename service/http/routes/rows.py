"""The same answers in long format, one flat object per row, for dashboards that read tables: Grafana's Infinity, spreadsheets."""

from collections.abc import Iterator
from typing import Annotated, Any

import orjson
from fastapi import APIRouter, Query, Response

from service.http.deps import NamedTwin, Running, reads
from service.http.routes import alarms as alarm_routes
from service.http.routes import live, telemetry
from service.instants import format_instant, now_us, parse_parameter
from service.live import forecasts
from service.schemas import ForecastRequest

router = APIRouter(prefix="/v1/twins/{twin}/rows", tags=["long format"])

Start = Annotated[str | None, Query(description="First instant, RFC 3339 or unix seconds.")]
Stop = Annotated[str | None, Query(description="First instant after the last one wanted.")]
Channels = Annotated[str | None, Query(description="Channels separated by commas; absent: all.")]
Points = Annotated[int, Query(ge=2, le=20_000, description="Most samples; beyond them those that hold extremes.")]
Row = dict[str, Any]
USUAL_POINTS = 1000
MOST_STEPS = 500


@router.get("/telemetry", dependencies=[reads])
async def telemetry_rows(
    service: Running,
    twin: NamedTwin,
    start: Start = None,
    stop: Stop = None,
    channels: Channels = None,
    max_points: Points = USUAL_POINTS,
) -> list[Row]:
    """Return readings: time, channel, value, unit."""
    answer = _document(await telemetry.archive(service, twin, start, stop, channels, max_points))
    units = answer["units"]
    return [
        {"time": time, "channel": name, "value": value, "unit": units[name]}
        for name, column in answer["values"].items()
        for time, value in zip(answer["time"], column, strict=True)
        if value is not None
    ]


@router.get("/residuals", dependencies=[reads])
async def residual_rows(
    service: Running,
    twin: NamedTwin,
    start: Start = None,
    stop: Stop = None,
    channels: Channels = None,
    max_points: Points = USUAL_POINTS,
) -> list[Row]:
    """Return innovations: time, channel, residual_K, std_K."""
    answer = _document(await live.list_residuals(service, twin, start, stop, None, max_points, False))
    return [
        {"time": time, "channel": name, "residual_K": residual, "std_K": spread}
        for name in _among(answer["residual_K"], channels, twin)
        for time, residual, spread in zip(
            answer["time"], answer["residual_K"][name], answer["std_K"][name], strict=True
        )
        if residual is not None
    ]


@router.get("/forecast", dependencies=[reads])
async def forecast_rows(
    service: Running, twin: NamedTwin, stop: Stop = None, channels: Channels = None, max_points: Points = 200
) -> list[Row]:
    """Return what is expected from the present state up to ``stop`` (an hour ahead of now): time, channel, mean, q05, q95, unit.

    Nothing where ``stop`` is past.
    """
    _, position = await forecasts.state_of(service.live.state(twin))
    stop_us = parse_parameter(stop, "stop") if stop is not None else now_us() + 3_600_000_000
    horizon_s = (stop_us - position.time_us) / 1e6
    if horizon_s <= 0.0:
        return []
    request = ForecastRequest(horizon_s=horizon_s, step_s=max(1.0, horizon_s / min(max_points, MOST_STEPS)))
    answer = _document(await live.forecast(service, twin, request))
    return [
        {"time": time, "channel": name, "unit": answer["units"][name]}
        | {what: columns[what][k] for what in ("mean", "q05", "q95")}
        for name in _among(answer["values"], channels, twin)
        for columns in (answer["values"][name],)
        for k, time in enumerate(answer["time"])
    ]


@router.get("/anomalies", dependencies=[reads])
async def anomaly_rows(service: Running, twin: NamedTwin, start: Start = None, stop: Stop = None) -> list[Row]:
    """Return anomalies: time, time_end (now while it lasts), sensor, message, score, cause, lasts."""
    found = await live.list_anomalies(service, twin, start, stop, None)
    return [
        {
            "time": row.start,
            "time_end": row.stop or format_instant(now_us()),
            "sensor": row.sensor,
            "message": row.message,
            "score": row.score,
            "cause": (row.cause or {}).get("effect"),
            "lasts": row.stop is None,
        }
        for row in found.anomalies
    ]


@router.get("/alarms", dependencies=[reads])
async def alarm_rows(service: Running, twin: NamedTwin) -> list[Row]:
    """Return stays beyond limits: time, time_end (now while it lasts), channel, colour, on, message, limit, unit, lasts."""
    found = await alarm_routes.list_alarms(service, twin)
    return [
        {
            "time": row.start,
            "time_end": row.stop or format_instant(now_us()),
            **row.model_dump(include={"channel", "colour", "on", "message", "limit", "unit"}),
            "lasts": row.stop is None,
        }
        for row in found.alarms
    ]


def _document(response: Response) -> Any:
    return orjson.loads(response.body)


def _among(held: dict[str, Any], channels: str | None, twin: Any) -> Iterator[str]:
    """Yield the sensors that were asked for; an unknown channel is refused as by the archive."""
    wanted = set(telemetry.named(channels, twin))
    return (name for name in held if name in wanted)
