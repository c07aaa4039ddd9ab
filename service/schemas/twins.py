"""A registered twin: its specification and its revisions, how far it is followed, how long its past is kept."""

from typing import Annotated, Any, Literal

from pydantic import Field

from service.schemas.base import Answer, Instant, Positive, Request


class TwinInfo(Answer):
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


class Assimilation(Answer):
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


class ChannelState(Answer):
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


class Standing(Answer):
    """Whether a model version still holds: ``lacks`` says what its specification and the twin's do not have in common."""

    version: int
    active: bool
    holds: bool
    lacks: list[str]


class RevisedTwin(TwinDetail):
    """A twin after its specification was changed."""

    models: list[Standing]


class Revision(Answer):
    """A former specification, and until when it held."""

    number: int
    until: Instant
    specification: dict[str, Any]


class RevisionList(Answer):
    """The former specifications of a twin, the newest first; ``current`` is the number of the present one."""

    current: int
    revisions: list[Revision]


class TwinGlance(TwinInfo):
    """A twin at a glance: what is open, and whether its sensors are heard: live, delayed, stale (all silent), partly or never."""

    open_anomalies: int = 0
    yellow: int = 0
    red: int = 0
    state: Literal["live", "delayed", "stale", "partly", "never"] = "never"


class TwinList(Answer):
    """Every registered twin."""

    twins: list[TwinGlance]


Days = Annotated[Positive, Field(le=100_000)]
"""Longer than from the first to the last instant that a sample may have."""
Newest = Annotated[int, Field(ge=0, le=1_000_000)]


class RetentionRequest(Request):
    """How long what belongs to a twin is kept; null: for ever.

    Days count back from the twin's newest sample; ``models`` and ``jobs`` are numbers of the newest ones that stay, beside the
    active model and its parent, and of jobs of each kind.
    """

    samples_days: Days | None = None
    residuals_days: Days | None = None
    models: Newest | None = None
    jobs: Newest | None = None


class Retention(Answer):
    """How long what belongs to a twin is kept."""

    samples_days: float | None
    residuals_days: float | None
    models: int | None
    jobs: int | None
