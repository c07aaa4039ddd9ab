"""Instants and finite numbers, and what all requests and all answers have in common."""

import math
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

Instant = str
"""RFC 3339 UTC."""


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
Positive = Annotated[Number, Field(gt=0)]
Time = Annotated[str | float, BeforeValidator(_time_form)]
Share = Annotated[Number, Field(gt=0, lt=1)]


class Request(BaseModel):
    """What a client sends: strict, and nothing beyond what is known."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Answer(BaseModel):
    """What the service answers: a client bears fields that it does not know."""

    model_config = ConfigDict(extra="allow")
