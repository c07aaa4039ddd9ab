"""Versions of a model."""

from typing import Any, Literal

from service.schemas.base import Answer, Instant

Source = Literal["calibration", "diagnosis", "manual"]


class ModelError(Answer):
    """The open-loop error of a model over the newest samples of the archive, the same ones for every version of a list."""

    rmse_K: float
    start: Instant
    stop: Instant
    samples: int


class ModelInfo(Answer):
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


class Activation(Answer):
    """When and why a version became the active one."""

    version: int
    time: Instant
    reason: str


class ModelList(Answer):
    """Every version of a twin's model, the oldest first, and the log of activations, the newest first."""

    models: list[ModelInfo]
    activations: list[Activation]
