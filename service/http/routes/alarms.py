"""Alarms of limits: list, acknowledge, shelve."""

from typing import Annotated

from fastapi import APIRouter, Path

from service.http.deps import NamedTwin, Running, operates, reads
from service.instants import now_us
from service.schemas import AcknowledgeRequest, Alarm, AlarmList, ShelveRequest
from service.store import alarms

router = APIRouter(prefix="/v1/twins/{twin}/alarms", tags=["alarms"])

MOST = 1000
Number = Annotated[int, Path(ge=1, le=2**62, description="Number of an alarm.")]


@router.get("", dependencies=[reads])
async def list_alarms(service: Running, twin: NamedTwin) -> AlarmList:
    """List the newest thousand alarms, those first that last and are not shelved."""
    rows = await service.database.read(alarms.select, twin.key, MOST)
    return AlarmList(alarms=[Alarm(**row.wire()) for row in rows])


@router.post("/{alarm}/acknowledge", dependencies=[operates])
async def acknowledge(
    service: Running, twin: NamedTwin, alarm: Number, request: AcknowledgeRequest | None = None
) -> Alarm:
    """Say that somebody has seen an alarm; it lasts on, and the next one is a new one."""
    note = None if request is None else request.note
    return Alarm(**(await service.database.write_to(twin.key, alarms.acknowledge, twin.key, alarm, note)).wire())


@router.post("/{alarm}/shelve", dependencies=[operates])
async def shelve(service: Running, twin: NamedTwin, alarm: Number, request: ShelveRequest) -> Alarm:
    """Hear nothing of the limit of an alarm for a while, whatever happens at it; other limits are watched as ever."""
    until_us = now_us() + round(request.for_s * 1e6) if request.for_s else None
    row = await service.database.write_to(twin.key, alarms.shelve, twin.key, alarm, until_us)
    service.live.shelved(twin)
    return Alarm(**row.wire())
