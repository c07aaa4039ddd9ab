"""What a stream tells."""

from typing import Literal

from service.schemas.base import Answer, Instant


class Message(Answer):
    """One message of a stream."""

    type: Literal["sample", "residual", "anomaly", "job", "model", "telemetry", "alarm", "twin", "stale", "dropped"]
    seq: int
    time: Instant
