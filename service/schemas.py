"""What travels over the wire. Clients import this module and nothing else of the service."""

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

Instant = str
"""RFC 3339 UTC."""

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
JobKind = Literal["calibration", "diagnosis"]
Inputs = Literal["auto", "repeat", "hold"]
Source = Literal["calibration", "diagnosis", "manual"]


def _finite(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("must be a number")
    if not abs(value) < math.inf:
        raise ValueError("is not a finite number")
    return value


def _time_form(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError("must be RFC 3339 or unix seconds")
    return value


Number = Annotated[float, BeforeValidator(_finite)]
Positive = Annotated[float, BeforeValidator(_finite), Field(gt=0)]
Time = Annotated[str | float, BeforeValidator(_time_form)]
Share = Annotated[float, BeforeValidator(_finite), Field(gt=0, lt=1)]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _Answer(BaseModel):
    model_config = ConfigDict(extra="allow")


class TwinInfo(_Answer):
    """A registered twin. Times are null while its archive is empty; ``quarantined`` samples are not part of it."""

    id: str
    created: Instant
    samples: int
    first_time: Instant | None
    last_time: Instant | None
    active_model: int | None
    quarantined: int = 0
    revision: int = 1
    seq: int
    channels: list[str]


class Assimilation(_Answer):
    """How far the active model has followed the archive: ``done`` of ``of`` samples, the rest in the background.

    ``since`` is where the part of the archive begins that is followed, null: all of it (``TWIN_ASSIMILATE_SAMPLES``);
    ``state_time`` is the instant of the present state, ``behind_s`` by how many seconds of telemetry that lies before the
    last sample.
    """

    done: int
    of: int
    state_time: Instant | None
    behind_s: float
    since: Instant | None = None


class ChannelState(_Answer):
    """When a channel was last heard of.

    ``last_time`` is the time that its newest reading bears, ``age_s`` for how long nothing has arrived since by the clock of
    the service, ``delay_s`` how old that reading was when it arrived, ``interval_s`` the usual distance of readings.
    ``state`` is live, delayed (arrives, but long after the fact), stale (silent for more than ``stale_after_s``) or never;
    ``signs`` are the anomalies that the readings themselves show now: stuck, quantised (they repeat) or dropout.
    """

    last_time: Instant | None
    age_s: float | None
    delay_s: float | None
    interval_s: float | None
    stale_after_s: float
    state: Literal["live", "delayed", "stale", "never"]
    signs: list[str] = []


class TwinDetail(TwinInfo):
    """A registered twin with its specification; ``catching_up`` while anomalies of what is stored may yet be found.

    ``assimilation`` is null without an active model, or where nothing is assimilated.
    """

    catching_up: bool = False
    assimilation: Assimilation | None = None
    telemetry: dict[str, ChannelState] = {}
    specification: dict[str, Any]


class Standing(_Answer):
    """Whether a model version still holds: ``lacks`` says what its specification and the twin's do not have in common."""

    version: int
    active: bool
    holds: bool
    lacks: list[str]


class RevisedTwin(TwinDetail):
    """A twin after its specification was changed."""

    models: list[Standing]


class Revision(_Answer):
    """A former specification, and until when it held."""

    number: int
    until: Instant
    specification: dict[str, Any]


class RevisionList(_Answer):
    """The former specifications of a twin, the newest first; ``current`` is the number of the present one."""

    current: int
    revisions: list[Revision]


class TwinGlance(TwinInfo):
    """A twin at a glance: what is open, and whether its sensors are heard: live, delayed, stale (all silent), partly or never."""

    open_anomalies: int = 0
    yellow: int = 0
    red: int = 0
    state: Literal["live", "delayed", "stale", "partly", "never"] = "never"


class TwinList(_Answer):
    """Every registered twin."""

    twins: list[TwinGlance]


class Worst(_Answer):
    """The residual that stands out most, in K and in its predicted standard deviations."""

    sensor: str
    residual_K: float
    deviations: float
    time: Instant


class FleetRow(_Answer):
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


class FleetCounts(_Answer):
    """How many twins there are of each kind."""

    all: int
    red: int
    yellow: int
    ahead: int
    anomalies: int
    stale: int
    no_model: int


class FleetPage(_Answer):
    """Some twins of the fleet, from ``offset`` on of those that match; ``counts`` is of all that were looked for."""

    counts: FleetCounts
    matched: int
    offset: int
    twins: list[FleetRow]


class NameList(_Answer):
    """The ids of all twins."""

    twins: list[str]


class Rejection(_Answer):
    """A well-formed sample that was not taken in."""

    index: int
    reason: str


class IngestReport(_Answer):
    """What became of the samples of one request.

    Those in ``quarantined``, which is there where any are, lie ahead of the receive clock: they are kept, but not in the archive.
    """

    accepted: int
    duplicates: int
    rejected: list[Rejection]
    quarantined: list[Rejection] = []
    last_time: Instant | None


class Interval(_Request):
    """start <= time < stop; absent: without an end on that side."""

    start: Time | None = None
    stop: Time | None = None


class Deletion(_Answer):
    """What was deleted, from the ``archive`` or the ``quarantine``; it can be undone until ``undo_until``, once."""

    id: int
    time: Instant
    place: Literal["archive", "quarantine"]
    start: Instant | None
    stop: Instant | None
    channels: list[str] | None
    samples: int
    undone: Instant | None
    undo_until: Instant | None


class DeletionList(_Answer):
    """Deletions of one twin, the newest first."""

    deletions: list[Deletion]


class Quarantine(_Answer):
    """Samples that lie ahead of the present, in the order of their arrival; ``samples`` are there in all."""

    samples: int
    time: list[Instant]
    received: list[Instant]
    values: dict[str, list[float | None]]


class AuditLine(_Answer):
    """One change or refusal: ``who`` is the name of a key, ``client`` an address."""

    id: int
    time: Instant
    who: str
    method: str
    path: str
    status: int
    client: str
    detail: str


class AuditList(_Answer):
    """Lines of the audit log, the newest first."""

    audit: list[AuditLine]


WebhookEvent = Literal["anomaly", "limit", "stale", "model", "job_failed"]
DeliveryState = Literal["waiting", "delivered", "dead"]


class WebhookRequest(_Request):
    """Where to send which events of which twins; null: all. Without a secret one is made."""

    url: Annotated[str, Field(max_length=2000)]
    twins: list[str] | None = None
    types: list[WebhookEvent] | None = None
    secret: Annotated[str, Field(min_length=16, max_length=200)] | None = None


class Webhook(_Answer):
    """A webhook without its secret."""

    id: int
    url: str
    twins: list[str] | None
    types: list[WebhookEvent] | None
    created: Instant


class WebhookMade(Webhook):
    """A webhook with the secret that signs what it is sent."""

    secret: str


class WebhookList(_Answer):
    """Every webhook."""

    webhooks: list[Webhook]


class WebhookDelivery(_Answer):
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


class DeliveryList(_Answer):
    """Deliveries, the newest first."""

    deliveries: list[WebhookDelivery]


class RetentionRequest(_Request):
    """How long what belongs to a twin is kept; null: for ever.

    Days count back from the twin's newest sample; ``models`` and ``jobs`` are numbers of the newest ones that stay, beside the
    active model and its parent, and of jobs of each kind.
    """

    samples_days: Positive | None = None
    residuals_days: Positive | None = None
    models: Annotated[int, Field(ge=0)] | None = None
    jobs: Annotated[int, Field(ge=0)] | None = None


class Retention(_Answer):
    """How long what belongs to a twin is kept."""

    samples_days: float | None
    residuals_days: float | None
    models: int | None
    jobs: int | None


class Columns(BaseModel):
    """Samples as columns: one value or null per time and channel, in the channel's own unit."""

    model_config = ConfigDict(extra="forbid", strict=True)

    time: list[Time]
    values: dict[str, list[Number | None]]


class Posted(Columns):
    """Samples on their way in; what the archive tells besides may stay: units must be the channels' own."""

    units: dict[str, str | None] = {}
    samples: int | None = None
    downsampled: bool | None = None


class Archive(_Answer):
    """A part of the archive; ``downsampled`` tells that extremes were kept and other samples left out."""

    time: list[Instant]
    values: dict[str, list[float | None]]
    units: dict[str, str | None]
    samples: int
    downsampled: bool


class _Selecting(_Request):
    """Which part of the archive a job looks at: the newest ``samples`` of start <= time < stop.

    With ``thin`` it looks at as many samples evenly over that time instead, of which inputs that hold have their mean.
    """

    start: Time | None = None
    stop: Time | None = None
    samples: Annotated[int, Field(ge=20)] | None = Field(default=None, description="absent: as TWIN_JOB_VALUES says")
    thin: bool = False


class CalibrationRequest(_Selecting):
    """What a calibration uses."""

    method: str = "second-order"
    activate: bool | None = Field(default=None, description="true: always, false: never, absent: if it is the better")


class DiagnosisRequest(_Selecting):
    """What a diagnosis uses and how much of it is held back for the score."""

    holdout: Share = 0.3
    burn_in_s: Positive | None = None
    false_alarm_rate: Annotated[float, BeforeValidator(_finite), Field(gt=0, lt=0.5)] = 0.01
    activate: bool = False


class Job(_Answer):
    """A calibration or a diagnosis."""

    id: str
    kind: JobKind
    state: JobState
    progress: float
    message: str
    created: Instant
    started: Instant | None
    finished: Instant | None
    result: dict[str, Any] | None

    @property
    def done(self) -> bool:
        """Whether the job has ended, well or not."""
        return self.state in ("succeeded", "failed", "cancelled")


class JobList(_Answer):
    """Jobs of one twin, the newest first."""

    jobs: list[Job]


class ModelError(_Answer):
    """The open-loop error of a model over the newest samples of the archive, the same ones for every version of a list."""

    rmse_K: float
    start: Instant
    stop: Instant
    samples: int


class ModelInfo(_Answer):
    """One version of a twin's model.

    ``validation`` is what its maker measured, each in its own way; ``error`` compares the versions of a list.
    """

    version: int
    active: bool
    created: Instant
    source: Source
    train: dict[str, Any]
    validation: dict[str, Any]
    effects: list[dict[str, Any]]
    error: ModelError | None = None


class ModelDetail(ModelInfo):
    """One version with the model itself, as the command line reads it."""

    model: dict[str, Any]


class Activation(_Answer):
    """When and why a version became the active one."""

    version: int
    time: Instant
    reason: str


class ModelList(_Answer):
    """Every version of a twin's model, the oldest first, and the log of activations, the newest first."""

    models: list[ModelInfo]
    activations: list[Activation]


class ForecastRequest(_Request):
    """How far to look ahead, and what the inputs will do.

    Without a plan ``auto`` repeats the last period of an input that has one and holds the others; ``repeat`` repeats and
    ``hold`` holds all of them. What comes from the orbit is computed.
    """

    horizon_s: Positive
    step_s: Positive | None = None
    plan: Columns | None = None
    inputs: Inputs = "auto"
    quantiles: list[Share] = Field(default=[0.05, 0.5, 0.95], min_length=1, max_length=20)


class Whole(_Answer):
    """Simultaneous bands: every reading of a sensor lies between its ``low`` and ``high`` with this probability."""

    probability: float
    values: dict[str, dict[str, list[float]]]


class Forecast(_Answer):
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


class Network(_Answer):
    """The thermal network at one moment: temperatures in K, heats in W; a link's heat flows from its first end on."""

    model_version: int
    time: Instant
    nodes: list[dict[str, Any]]
    boundaries: list[dict[str, Any]]
    links: list[dict[str, Any]]
    loads: list[dict[str, Any]]
    effects: list[dict[str, Any]]


class MaskedSpan(_Answer):
    """Samples next to each other, first and last, that are no readings: frozen, rail, sentinel or spike."""

    start: Instant
    stop: Instant
    reason: str
    samples: int


class Residuals(_Answer):
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
    downsampled: bool = False


class Anomaly(_Answer):
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


class AnomalyList(_Answer):
    """Anomalies of one twin: those that last first, then the newest."""

    anomalies: list[Anomaly]


class Acknowledgement(_Answer):
    """When an operator said that he has seen an alarm, and what he added."""

    time: Instant
    note: str | None


class Alarm(_Answer):
    """A stay of a channel beyond a limit, measured or forecast; ``stop`` is null while it lasts.

    A measured one tells the ``worst`` reading; a forecast one when the limit is ``expected`` to be reached, with the ends of
    its 90 % interval, ``earliest`` and ``latest``. Values are in the channel's own unit.
    """

    id: int
    on: Literal["measured", "forecast"]
    channel: str
    colour: Literal["yellow", "red"]
    side: Literal["low", "high"]
    limit: float
    start: Instant
    stop: Instant | None
    unit: str | None
    message: str
    worst: float | None = None
    expected: Instant | None = None
    earliest: Instant | None = None
    latest: Instant | None = None
    acknowledged: Acknowledgement | None
    shelved_until: Instant | None


class AlarmList(_Answer):
    """Alarms of one twin: those first that last and are not shelved, the red ones before the yellow ones."""

    alarms: list[Alarm]


class AcknowledgeRequest(_Request):
    """What to add to an acknowledgement."""

    note: Annotated[str, Field(max_length=500)] | None = None


class ShelveRequest(_Request):
    """For how long nothing is to be heard of a limit; 0 takes it up again."""

    for_s: Annotated[float, BeforeValidator(_finite), Field(ge=0, le=31_536_000)]


class Message(_Answer):
    """One message of a stream."""

    type: Literal["sample", "residual", "anomaly", "job", "model", "telemetry", "alarm", "twin", "stale", "dropped"]
    seq: int
    time: Instant
