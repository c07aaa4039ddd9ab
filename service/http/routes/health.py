"""Liveness, readiness and metrics."""

from fastapi import APIRouter, Response

from service.http.deps import Running, reads
from service.monitoring.metrics import CONTENT_TYPE
from service.store import twins

router = APIRouter(tags=["health"])


@router.get("/healthz")
async def live() -> dict[str, str]:
    """Answer as long as the process runs."""
    return {"status": "ok"}


@router.get("/readyz")
async def ready(service: Running) -> dict[str, str]:
    """Answer once the store can be read."""
    await service.database.read(twins.select)
    return {"status": "ready"}


@router.get("/metrics", dependencies=[reads])
async def metrics(service: Running) -> Response:
    """Return the metrics in the text format of Prometheus; without those of twins while the database does not answer."""
    await service.metrics.look(service.database, at_twins=True)
    return Response(service.metrics.render(), media_type=CONTENT_TYPE)
