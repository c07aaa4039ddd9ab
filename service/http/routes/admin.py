"""What concerns the service rather than a twin: the audit log and webhooks."""

from typing import Annotated
from urllib.parse import urlsplit

from fastapi import APIRouter, Path, Query

from service.errors import BadField, short
from service.http.deps import Note, Running, operates
from service.schemas import (
    AuditLine,
    AuditList,
    DeliveryList,
    DeliveryState,
    Webhook,
    WebhookDelivery,
    WebhookList,
    WebhookMade,
    WebhookRequest,
)
from service.store import audit as audit_table
from service.store import webhooks as webhook_table
from service.store.errors import Missing

audit = APIRouter(prefix="/v1/audit", tags=["administration"])
webhooks = APIRouter(prefix="/v1/webhooks", tags=["administration"])
Number = Annotated[int, Path(ge=1, le=2**62, description="Its number.")]


@audit.get("", dependencies=[operates])
async def list_audit(
    service: Running,
    limit: Annotated[int, Query(ge=1, le=1000, description="Most lines in the answer.")] = 100,
    before: Annotated[int | None, Query(ge=1, le=2**62, description="Only lines before this one.")] = None,
) -> AuditList:
    """List who changed what and who was refused, the newest first."""
    await service.database.write(audit_table.settled)
    rows = await service.database.read(audit_table.select, limit, before)
    return AuditList(audit=[AuditLine(**row) for row in rows])


@webhooks.post("", status_code=201, dependencies=[operates])
async def add(service: Running, request: WebhookRequest, note: Note) -> WebhookMade:
    """Let a server hear of events; the answer has the secret that signs them, which is never shown again."""
    for index, name in enumerate(request.twins or ()):
        try:
            await service.find_now(name)
        except Missing:
            raise BadField(f"twins[{index}]", f"there is no twin '{short(name)}'; register it first") from None
    made = await service.database.write(webhook_table.add, request.url, request.twins, request.types, request.secret)
    note(_named(made))
    return WebhookMade(**made.wire(), secret=made.secret)


@webhooks.get("", dependencies=[operates])
async def list_webhooks(service: Running) -> WebhookList:
    """List the webhooks."""
    rows = await service.database.read(webhook_table.select)
    return WebhookList(webhooks=[Webhook(**row.wire()) for row in rows])


@webhooks.delete("/{webhook}", status_code=204, dependencies=[operates])
async def remove(service: Running, webhook: Number, note: Note) -> None:
    """Delete a webhook; what was not delivered yet is dropped."""
    note(_named(await service.database.write(webhook_table.remove, webhook)))


def _named(hook: webhook_table.Webhook) -> str:
    """Return number, host and events of a webhook; the rest of its URL may hold a secret."""
    events = "all events" if hook.types is None else ", ".join(hook.types)
    return f"webhook {hook.id} at {urlsplit(hook.url).hostname}: {events}"


@webhooks.get("/deliveries", dependencies=[operates])
async def list_deliveries(
    service: Running,
    state: Annotated[DeliveryState | None, Query(description="waiting, delivered or dead; absent: all.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000, description="Most deliveries in the answer.")] = 100,
) -> DeliveryList:
    """List deliveries, the newest first; those that were given up are dead."""
    rows = await service.database.read(webhook_table.deliveries, state, limit)
    return DeliveryList(deliveries=[WebhookDelivery(**row.wire()) for row in rows])


@webhooks.post("/deliveries/{delivery}/retry", dependencies=[operates])
async def retry(service: Running, delivery: Number) -> WebhookDelivery:
    """Try a delivery once more."""
    row = await service.database.write(webhook_table.retry, delivery)
    return WebhookDelivery(**row.wire())
