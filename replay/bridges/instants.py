"""Instants at the bridges: integer milliseconds since 1970 in UTC, the resolution of Yamcs."""

import re
from datetime import UTC, datetime, timedelta

import numpy as np

from replay.bridges.errors import BridgeError

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_RFC3339 = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d+)?(Z|[+-]\d\d:\d\d)")


def parse_utc_ms(text: str) -> int:
    """Return RFC 3339 text as milliseconds, rounded; BridgeError without a time zone, which nobody is to guess."""
    if not _RFC3339.fullmatch(text):
        raise BridgeError(f"'{text}' is no instant such as 2026-03-01T00:00:00Z; the zone must be stated")
    return to_ms(datetime.fromisoformat(text.replace("Z", "+00:00")))


def service_ms(text: str) -> int:
    """Return an instant of the service, RFC 3339 UTC, as milliseconds, rounded."""
    return round(int(np.datetime64(text.removesuffix("Z"), "us").astype(np.int64)) / 1000)


def to_ms(when: datetime) -> int:
    """Return an aware datetime as milliseconds, rounded."""
    return round((when - _EPOCH) / timedelta(microseconds=1) / 1000)


def to_datetime(time_ms: int) -> datetime:
    """Return milliseconds as an aware datetime."""
    return _EPOCH + timedelta(milliseconds=time_ms)


def to_text(time_ms: int) -> str:
    """Return milliseconds as RFC 3339 UTC."""
    return f"{np.datetime64(time_ms, 'ms')}Z"


def now_ms() -> int:
    """Return the present by the clock of this machine."""
    return to_ms(datetime.now(UTC))
