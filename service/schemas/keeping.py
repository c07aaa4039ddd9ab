"""The log of changes, and webhooks."""

from typing import Annotated, Any, Literal

from pydantic import Field

from service.schemas.base import Answer, Instant, Request


class AuditLine(Answer):
    """One change or refusal: ``who`` is the name of a key, ``client`` an address."""

    id: int
    time: Instant
    who: str
    method: str
    path: str
    status: int
    client: str
    detail: str


class AuditList(Answer):
    """Lines of the audit log, the newest first."""

    audit: list[AuditLine]


WebhookEvent = Literal["anomaly", "limit", "stale", "model", "job_failed"]
DeliveryState = Literal["waiting", "delivered", "dead"]


class WebhookRequest(Request):
    """Where to send which events of which twins; null: all. Without a secret one is made."""

    url: Annotated[str, Field(max_length=2000)]
    twins: list[str] | None = None
    types: list[WebhookEvent] | None = None
    secret: Annotated[str, Field(min_length=16, max_length=200)] | None = None


class Webhook(Answer):
    """A webhook without its secret."""

    id: int
    url: str
    twins: list[str] | None
    types: list[WebhookEvent] | None
    created: Instant


class WebhookMade(Webhook):
    """A webhook with the secret that signs what it is sent."""

    secret: str


class WebhookList(Answer):
    """Every webhook."""

    webhooks: list[Webhook]


class WebhookDelivery(Answer):
    """One message to a webhook; ``reason`` says what went wrong last, ``next`` when it is tried again."""

    id: int
    webhook: int
    created: Instant
    event: WebhookEvent
    state: DeliveryState
    attempts: int
    next: Instant | None
    reason: str
    body: dict[str, Any]


class DeliveryList(Answer):
    """Deliveries, the newest first."""

    deliveries: list[WebhookDelivery]
