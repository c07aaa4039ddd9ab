"""Samples on their way in and out, their deletion and quarantine."""

from typing import Literal

from pydantic import BaseModel, ConfigDict

from service.schemas.base import Answer, Instant, Number, Request, Time


class Rejection(Answer):
    """A well-formed sample that was not taken in."""

    index: int
    reason: str


class IngestReport(Answer):
    """What became of the samples of one request.

    Those in ``quarantined``, which is there where any are, lie ahead of the receive clock: they are kept, but not in the archive.
    """

    accepted: int
    duplicates: int
    rejected: list[Rejection]
    quarantined: list[Rejection] = []
    last_time: Instant | None


class Interval(Request):
    """start <= time < stop; absent: without an end on that side."""

    start: Time | None = None
    stop: Time | None = None


class Deletion(Answer):
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


class DeletionList(Answer):
    """Deletions of one twin, the newest first."""

    deletions: list[Deletion]


class Quarantine(Answer):
    """Samples that lie ahead of the present, in the order of their arrival; ``samples`` are there in all."""

    samples: int
    time: list[Instant]
    received: list[Instant]
    values: dict[str, list[float | None]]


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


class Archive(Answer):
    """A part of the archive; ``downsampled`` tells that extremes were kept and other samples left out."""

    time: list[Instant]
    values: dict[str, list[float | None]]
    units: dict[str, str | None]
    samples: int
    downsampled: bool
