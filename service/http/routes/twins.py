"""Twins: register, list, inspect, delete."""

import contextlib
from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, Request, Response

from service.errors import BadField
from service.http.deps import NamedTwin, Note, Running, Service, operates, reads
from service.http.specification_body import BODY, read_specification
from service.instants import format_instant, now_us
from service.live import forecasts
from service.schemas import (
    Assimilation,
    ChannelState,
    Retention,
    RetentionRequest,
    RevisedTwin,
    Revision,
    RevisionList,
    Standing,
    TwinDetail,
    TwinGlance,
    TwinList,
)
from service.store import anomalies, fleet, models, retention, twins
from service.store.connection import Connection
from service.store.errors import Missing
from service.store.twins import Twin
from service.twins.fit import lacks
from service.twins.registry import Entry

OF_READINGS = ("stuck", "quantised", "dropout")
"""Anomalies that the readings themselves show, whatever the model says."""

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
        "revision": twin.revision,
        "seq": twin.seq,
        "channels": list(twin.channels),
    }


async def _detail(service: Service, twin: Twin) -> TwinDetail:
    entry = service.registry.get(twin.name)
    tracker = await service.live.seen(entry)
    catching_up = tracker is not None and tracker.catching_up
    progress = None
    if tracker is not None and tracker.active is not None:
        lag = await forecasts.behind(tracker, service.database)
        state_us = None if tracker.position is None else tracker.position.time_us
        since = _when(tracker.floor_us)
        progress = Assimilation(done=lag.done, of=lag.of, state_time=_when(state_us), behind_s=lag.seconds, since=since)
    return TwinDetail(
        **_info(twin),
        catching_up=catching_up,
        assimilation=progress,
        telemetry=await _telemetry(service, entry, twin.active_version),
        specification=twin.specification,
    )


async def _telemetry(service: Service, twin: Entry, version: int | None) -> dict[str, ChannelState]:
    """Return how each channel stands."""
    beats, at_us = await service.live.beats(twin), now_us()
    open_kinds = await service.database.read(anomalies.open_kinds, twin.key, version)
    return {
        name: ChannelState(
            last_time=_when(beat.last_us),
            age_s=beat.silent_s(at_us),
            delay_s=beat.delay_s,
            interval_s=beat.interval_s,
            stale_after_s=beat.stale_after_s,
            state=beat.standing(at_us),
            signs=[kind for kind in open_kinds.get(name, []) if kind in OF_READINGS],
        )
        for name, beat in beats.items()
    }


@router.post("", status_code=201, dependencies=[operates], openapi_extra=BODY)
async def register(service: Running, response: Response, request: Request, note: Note) -> TwinDetail:
    """Register a specification, JSON or YAML (201); the identical one again answers 200, another one under its id 409."""
    given = await read_specification(request)
    note(given.spec.twin)  # a refusal is to name it, too
    twin, is_new = await service.register(given.spec, given.data)
    note(f"{twin.name}, revision {twin.revision}")
    response.status_code = 201 if is_new else 200
    response.headers["Location"] = f"/v1/twins/{twin.name}"
    return await _detail(service, twin)


@router.get("", dependencies=[reads])
async def list_twins(service: Running) -> TwinList:
    """List every twin with what is open and whether its telemetry is live."""
    glances = {one.name: one for one in await service.database.read(fleet.glances)}
    listed = []
    for twin in await service.database.read(twins.select):
        with contextlib.suppress(Missing, KeyError):  # it is being deleted, or was registered just now
            listed.append((twin, glances[twin.name], service.registry.get(twin.name)))
    states = await service.live.standings([entry for _, _, entry in listed])
    found = []
    for (twin, one, _), (state, _) in zip(listed, states, strict=True):
        counts = {"open_anomalies": one.open_anomalies, "yellow": one.yellow, "red": one.red}
        found.append(TwinGlance(**_info(twin) | counts | {"state": state}))
    return TwinList(twins=found)


@router.get("/{twin}", dependencies=[reads])
async def inspect(service: Running, twin: NamedTwin) -> TwinDetail:
    """Return one twin with its specification."""
    return await _detail(service, await service.database.read(twins.get, twin.name))


@router.put("/{twin}", dependencies=[operates], openapi_extra=BODY)
async def revise(service: Running, twin: NamedTwin, request: Request, note: Note) -> RevisedTwin:
    """Give the twin another specification (a new sensor, load or limit); archive and models stay.

    The answer says which models still hold. A channel cannot be removed, nor change its kind or unit.
    """
    given = await read_specification(request)
    if given.spec.twin != twin.name:
        raise BadField("twin", f"is '{given.spec.twin}', the path names '{twin.name}'")
    made, is_new = await service.revise(twin, given.spec, given.data)
    note(f"{twin.name}, revision {made.revision}{'' if is_new else ' as before'}")
    detail = await _detail(service, made)
    standing = await service.database.read(_standing, made)
    return RevisedTwin(**detail.model_dump(), models=standing)


def _standing(connection: Connection, twin: Twin) -> list[Standing]:
    """Return of each model version what its specification and the twin's do not have in common."""
    found = []
    for row in models.select(connection, twin.key):
        missing = lacks(models.document(connection, twin.key, row.version)["spec"], twin.specification)
        found.append(Standing(version=row.version, active=row.active, holds=not missing, lacks=missing))
    return found


@router.get("/{twin}/revisions", dependencies=[reads])
async def list_revisions(service: Running, twin: NamedTwin) -> RevisionList:
    """List the former specifications, the newest first."""
    rows = await service.database.read(twins.revisions, twin.key)
    former = [Revision(number=n, until=format_instant(at_us), specification=text) for n, at_us, text in rows]
    return RevisionList(current=twin.revision, revisions=former)


@router.get("/{twin}/retention", dependencies=[reads])
async def keeps(service: Running, twin: NamedTwin) -> Retention:
    """Return how long what belongs to the twin is kept."""
    return Retention(**asdict(await service.database.read(retention.get, twin.key)))


@router.put("/{twin}/retention", dependencies=[operates])
async def keep(service: Running, twin: NamedTwin, request: RetentionRequest, note: Note) -> Retention:
    """Settle how long what belongs to the twin is kept; what is older goes for ever, within minutes."""
    wanted = retention.Retention(**request.model_dump())
    former = await service.database.write_to(twin.key, retention.put, twin.key, wanted)
    note(wanted.changes(former))
    service.housekeeping.wake()
    return Retention(**asdict(wanted))


@router.delete("/{twin}", status_code=204, dependencies=[operates])
async def delete(service: Running, twin: NamedTwin) -> None:
    """Delete a twin with its archive, models and jobs."""
    await service.remove_twin(twin)
