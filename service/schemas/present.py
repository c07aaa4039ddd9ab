"""The present of a twin and its future: forecasts, heat flows, residuals, anomalies."""

from typing import Any, Literal

from pydantic import Field

from service.schemas.base import Answer, Instant, Positive, Request, Share
from service.schemas.telemetry import Columns

Inputs = Literal["auto", "repeat", "hold"]


class ForecastRequest(Request):
    """How far to look ahead, and what the inputs will do.

    Without a plan ``auto`` repeats the last period of an input that has one and holds the others; ``repeat`` repeats and
    ``hold`` holds all of them. What comes from the orbit is computed.
    """

    horizon_s: Positive
    step_s: Positive | None = None
    plan: Columns | None = None
    inputs: Inputs = "auto"
    quantiles: list[Share] = Field(default=[0.05, 0.5, 0.95], min_length=1, max_length=20)


class Whole(Answer):
    """Simultaneous bands: every reading of a sensor lies between its ``low`` and ``high`` with this probability."""

    probability: float
    values: dict[str, dict[str, list[float]]]


class Forecast(Answer):
    """Expected temperatures with quantiles ``q05`` and so on, each in its channel's unit.

    ``inputs`` says where the future of each input and boundary channel comes from, ``from`` at which instant the forecast
    starts, ``behind_s`` by how many seconds of telemetry that lies before the last sample, ``limits`` which limits are reached
    when: ``expected`` in every second future, ``earliest`` in 5 % and ``latest`` in 95 % of them.
    """

    model_version: int
    issued: Instant
    from_: Instant | None = Field(default=None, alias="from")
    behind_s: float = 0.0
    time: list[Instant]
    values: dict[str, dict[str, list[float]]]
    whole: Whole | None = None
    units: dict[str, str | None]
    inputs: dict[str, Literal["plan", "orbit", "repeat", "hold"]] = {}
    limits: list[dict[str, Any]] = []
    notices: list[str] = []


class Network(Answer):
    """The thermal network at one moment: temperatures in K, heats in W; a link's heat flows from its first end on."""

    model_version: int
    time: Instant
    nodes: list[dict[str, Any]]
    boundaries: list[dict[str, Any]]
    links: list[dict[str, Any]]
    loads: list[dict[str, Any]]
    effects: list[dict[str, Any]]


class MaskedSpan(Answer):
    """Samples next to each other, first and last, that are no readings: frozen, rail, sentinel or spike."""

    start: Instant
    stop: Instant
    reason: str
    samples: int


class Residuals(Answer):
    """Innovations (measured minus predicted one step ahead) and their normalised squares; thinned if ``downsampled``."""

    time: list[Instant]
    residual_K: dict[str, list[float | None]]
    nis: list[float | None]
    model_version: list[int]
    masked: dict[str, list[MaskedSpan]] | None = Field(
        default=None, description="Spans of each sensor that are no readings; null where the answer is too long to say."
    )
    predicted: dict[str, list[float | None]] | None = Field(
        default=None, description="In the channels' units, if asked for and the answer is not too long."
    )
    samples: int = Field(default=0, description="How many residuals there are in this span.")
    downsampled: bool = False
    complete: bool = Field(
        default=True, description="Whether every sample that was stored when this was asked is compared with its model."
    )


class Anomaly(Answer):
    """An interval in which a sensor does not behave as its model; ``stop`` is null while it lasts.

    ``message`` says it in words.
    """

    id: int
    sensor: str
    start: Instant
    stop: Instant | None
    score: float
    cause: dict[str, Any] | None
    message: str = ""


class AnomalyList(Answer):
    """Anomalies of one twin: those that last first, then the newest."""

    anomalies: list[Anomaly]
