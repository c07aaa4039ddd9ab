"""Calibrations and diagnoses."""

from typing import Annotated, Any, Literal

from pydantic import Field

from service.schemas.base import Answer, Instant, Number, Positive, Request, Share, Time

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
JobKind = Literal["calibration", "diagnosis"]


class _Selecting(Request):
    """Which part of the archive a job looks at: the newest ``samples`` of start <= time < stop.

    With ``thin`` it looks at as many samples evenly over that time instead, of which inputs that hold have their mean.
    Its search ends after ``deadline_s`` with the best so far.
    """

    start: Time | None = None
    stop: Time | None = None
    samples: Annotated[int, Field(ge=20, le=1_000_000_000)] | None = Field(
        default=None, description="absent: as TWIN_JOB_VALUES says"
    )
    thin: bool = False
    deadline_s: Positive | None = Field(default=None, description="absent: as TWIN_JOB_SEARCH_S says")


class CalibrationRequest(_Selecting):
    """What a calibration uses."""

    method: str = "second-order"
    activate: bool | None = Field(default=None, description="true: always, false: never, absent: if it is the better")


class DiagnosisRequest(_Selecting):
    """What a diagnosis uses and how much of it is held back for the score."""

    holdout: Share | None = Field(
        default=None, description="absent: 0.3, or half of the time since the first open anomaly that began within that"
    )
    burn_in_s: Positive | None = None
    false_alarm_rate: Annotated[Number, Field(gt=0, lt=0.5)] = 0.01
    activate: bool = False


class Job(Answer):
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


class JobList(Answer):
    """Jobs of one twin, the newest first."""

    jobs: list[Job]
