"""The log of changes, and webhooks."""

from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, HttpUrl, TypeAdapter, ValidationError

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


_HTTP_URL = TypeAdapter(HttpUrl)


def _leads_somewhere(url: str) -> str:
    """Return the URL as it was sent; the parser alone would mend spaces, backslashes and a host that is missing."""
    try:
        _HTTP_URL.validate_python(url)
    except ValidationError as error:
        raise ValueError(f"must be a URL of http or https: {error.errors()[0]['msg']}") from None
    if not url.isprintable() or " " in url or "\\" in url or not urlsplit(url).hostname:
        raise ValueError("must begin with http:// or https://, name a host and hold no spaces")
    return url


class WebhookRequest(Request):
    """Where to send which events of which twins; null: all. Without a secret one is made."""

    url: Annotated[str, Field(max_length=2000), AfterValidator(_leads_somewhere)]
    twins: Annotated[list[str], Field(min_length=1)] | None = None
    types: Annotated[list[WebhookEvent], Field(min_length=1)] | None = None
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
