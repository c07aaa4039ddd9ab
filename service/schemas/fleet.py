"""Many twins at once."""

from typing import Any, Literal

from service.schemas.base import Answer, Instant


class Worst(Answer):
    """The residual that stands out most, in K and in its predicted standard deviations."""

    sensor: str
    residual_K: float
    deviations: float
    time: Instant


class FleetRow(Answer):
    """One twin of the fleet; ``silent_s`` is how long nothing has arrived, ``ahead`` the limit that is expected first.

    ``yellow`` and ``red`` count the limits that readings are beyond.
    """

    id: str
    family: str | None
    state: Literal["live", "delayed", "stale", "partly", "never"]
    silent_s: float | None
    last_time: Instant | None
    samples: int
    worst: Worst | None
    ahead: dict[str, Any] | None
    open_anomalies: int
    yellow: int
    red: int
    active_model: int | None
    model_age_s: float | None


class FleetCounts(Answer):
    """How many twins there are of each kind."""

    all: int
    red: int
    yellow: int
    ahead: int
    anomalies: int
    stale: int
    no_model: int


class FleetPage(Answer):
    """Some twins of the fleet, from ``offset`` on of those that match; ``counts`` is of all that were looked for."""

    counts: FleetCounts
    matched: int
    offset: int
    twins: list[FleetRow]


class NameList(Answer):
    """The ids of all twins."""

    twins: list[str]
