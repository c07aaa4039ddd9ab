"""Twins: register, list, inspect, delete."""

from typing import Annotated, Any

from fastapi import APIRouter, Body, Response

from service.deps import NamedTwin, Running, Service, operates, reads
from service.instants import format_instant
from service.live import forecasts
from service.schemas import Assimilation, TwinDetail, TwinInfo, TwinList
from service.store import twins
from service.store.twins import Twin
from twin_core.network.spec_io import dump_spec, load_spec

router = APIRouter(prefix="/v1/twins", tags=["twins"])


def _when(instant_us: int | None) -> str | None:
    return None if instant_us is None else format_instant(instant_us)


def _info(twin: Twin) -> dict[str, Any]:
    return {
        "id": twin.name,
        "created": format_instant(twin.created_us),
        "samples": twin.samples,
        "first_time": _when(twin.first_us),
        "last_time": _when(twin.last_us),
        "active_model": twin.active_version,
        "quarantined": twin.quarantined,
        "seq": twin.seq,
        "channels": list(twin.channels),
    }


async def _detail(service: Service, twin: Twin) -> TwinDetail:
    tracker = service.live.find(twin.key)
    catching_up = tracker is not None and tracker.catching_up
    progress = None
    if tracker is not None and tracker.active is not None:
        lag = await forecasts.behind(tracker, service.database)
        state_us = None if tracker.position is None else tracker.position.time_us
        progress = Assimilation(done=lag.done, of=lag.of, state_time=_when(state_us), behind_s=lag.seconds)
    return TwinDetail(**_info(twin), catching_up=catching_up, assimilation=progress, specification=twin.specification)


@router.post("", status_code=201, dependencies=[operates])
async def register(service: Running, response: Response, body: Annotated[dict[str, Any], Body()]) -> TwinDetail:
    """Register a specification (201); the identical one again answers 200, another one under its id 409."""
    spec = load_spec(body)
    twin, is_new = await service.register(spec.twin, dump_spec(spec))
    response.status_code = 201 if is_new else 200
    response.headers["Location"] = f"/v1/twins/{twin.name}"
    return await _detail(service, twin)


@router.get("", dependencies=[reads])
async def list_twins(service: Running) -> TwinList:
    """List every twin."""
    return TwinList(twins=[TwinInfo(**_info(twin)) for twin in await service.database.read(twins.select)])


@router.get("/{twin}", dependencies=[reads])
async def inspect(service: Running, twin: NamedTwin) -> TwinDetail:
    """Return one twin with its specification."""
    return await _detail(service, await service.database.read(twins.get, twin.name))


@router.delete("/{twin}", status_code=204, dependencies=[operates])
async def delete(service: Running, twin: NamedTwin) -> None:
    """Delete a twin with its archive, models and jobs."""
    await service.remove_twin(twin)
