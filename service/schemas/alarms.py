"""Limits that are passed or will be."""

from typing import Annotated, Literal

from pydantic import Field

from service.schemas.base import Answer, Instant, Number, Request


class Acknowledgement(Answer):
    """When an operator said that he has seen an alarm, and what he added."""

    time: Instant
    note: str | None


class Alarm(Answer):
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


class AlarmList(Answer):
    """Alarms of one twin: those first that last and are not shelved, the red ones before the yellow ones."""

    alarms: list[Alarm]


class AcknowledgeRequest(Request):
    """What to add to an acknowledgement."""

    note: Annotated[str, Field(max_length=500)] | None = None


class ShelveRequest(Request):
    """For how long nothing is to be heard of a limit; 0 takes it up again."""

    for_s: Annotated[Number, Field(ge=0, le=31_536_000)]
