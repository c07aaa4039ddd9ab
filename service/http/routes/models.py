"""Model versions: list, inspect, activate, bring one along."""

from collections.abc import Sequence
from typing import Annotated, Any

import orjson
from fastapi import APIRouter, Body, Path
from pydantic import AfterValidator

from service.http.deps import NamedTwin, Note, Running, operates, reads
from service.jobs import outcome
from service.schemas import Activation, ModelDetail, ModelInfo, ModelList
from service.store import models, retention
from service.store.connection import Connection
from service.stream.messages import Stretch
from service.twins.fit import refuse_foreign
from twin_core import __version__
from twin_core.network.spec_io import load_spec

router = APIRouter(prefix="/v1/twins/{twin}/models", tags=["models"])

MOST_COMPARED = 30
"""So many of the newest versions are compared over the same telemetry."""


def _storable(document: dict[str, Any]) -> dict[str, Any]:
    try:
        orjson.dumps(document)
    except TypeError as error:  # integers beyond 64 bits, and what is nested too deeply
        raise ValueError(f"cannot be stored: {error}") from None
    return document


Version = Annotated[int, Path(ge=1, le=2**62, description="Number of a version.")]


@router.get("", dependencies=[reads])
async def list_models(service: Running, twin: NamedTwin) -> ModelList:
    """List every version, the oldest first, and the log of activations."""
    rows = await service.database.read(models.select, twin.key)
    log = await service.database.read(models.activations, twin.key)
    errors = await service.live.scores.of(twin, [row.version for row in rows][-MOST_COMPARED:])
    return ModelList(
        models=[ModelInfo(**row.wire() | {"error": errors.get(row.version)}) for row in rows],
        activations=[Activation(**entry) for entry in log],
    )


@router.get("/{version}", dependencies=[reads])
async def inspect(service: Running, twin: NamedTwin, version: Version) -> ModelDetail:
    """Return one version with the model itself, as the command line reads it."""
    row = await service.database.read(models.get, twin.key, version)
    document = await service.database.read(models.document, twin.key, version)
    return ModelDetail(**row.wire(), model=document)


@router.post("/{version}/activate", dependencies=[operates])
async def activate(service: Running, twin: NamedTwin, version: Version, note: Note) -> ModelInfo:
    """Make a version the active one: an upgrade or a roll-back."""
    former, row = await service.hub.write(twin.key, _activate, twin.key, version)
    note(f"version {former or 'none'} -> {version}")
    service.live.model_changed(twin.key)
    return ModelInfo(**row.wire())


def _activate(
    connection: Connection, twin: int, version: int
) -> tuple[tuple[int | None, models.ModelRow], Sequence[Stretch]]:
    """Make a version the active one; return the former one's number, too."""
    former = models.active_version(connection, twin)
    row, stretches = outcome.activate(connection, twin, version, "requested")
    return (former, row), stretches


@router.delete("/{version}", status_code=204, dependencies=[operates])
async def delete(service: Running, twin: NamedTwin, version: Version) -> None:
    """Delete a version that is not active, with its residuals and anomalies."""
    await service.database.write_to(twin.key, retention.delete_model, twin.key, version)
    service.housekeeping.wake()


@router.post("", status_code=201, dependencies=[operates])
async def add(
    service: Running, twin: NamedTwin, body: Annotated[dict[str, Any], Body(), AfterValidator(_storable)], note: Note
) -> ModelInfo:
    """Store a model that the command line made for this twin as a new version, not active."""
    made = await service.live.inspect(body)
    refuse_foreign(load_spec(made.document["spec"]), twin)
    head = await service.database.read(models.first_us, twin.key)
    provenance = {"code_version": __version__, "settings": {}, "epoch_us": head, "data_sha256": None, "parent": None}
    row = await service.hub.write(twin.key, outcome.add_manual, twin.key, made, provenance)
    note(f"version {row.version}")
    return ModelInfo(**row.wire())
