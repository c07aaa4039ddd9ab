"""Where an assimilation stands, and what the filter needs to go on from there."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.registry import Entry
from service.store.checkpoints import Checkpoint
from service.store.samples import Samples
from service.workbench import Telemetry

Json = dict[str, Any]


@dataclass(frozen=True)
class Position:
    """Where the assimilation stands: the last assimilated sample, its state, and the inputs that hold there."""

    time_us: int
    n_samples: int
    state: Json
    held: dict[str, float]
    detector: Json
    sampling_s: float

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> "Position":
        """Return the position that a checkpoint describes."""
        body = checkpoint.body
        return cls(
            checkpoint.time_us, checkpoint.n_samples, body["state"], body["held"], body["detector"], body["sampling_s"]
        )

    def checkpoint(self) -> Checkpoint:
        """Return the checkpoint that describes this position."""
        names = ("state", "held", "detector", "sampling_s")
        return Checkpoint(self.time_us, self.n_samples, {name: getattr(self, name) for name in names})


def stretch(twin: Entry, fresh: Samples, epoch_us: int, before: Position | None) -> tuple[Telemetry, dict[str, float]]:
    """Return a block for the filter and the inputs that hold at its end.

    It opens with the sample that the state knows already, of which only the inputs matter.
    """
    held = {} if before is None else before.held
    known = 0 if before is None else 1
    values: dict[str, NDArray[np.float64]] = {}
    after = dict(held)
    for row, name in enumerate(twin.channels):
        is_sensor = name in twin.sensors
        first = np.full(known, np.nan if is_sensor else held.get(name, np.nan))
        column = np.concatenate([first, fresh.values[row]])
        seen = np.flatnonzero(np.isfinite(column))
        if seen.size and not is_sensor:
            after[name] = float(column[seen[-1]])
        if is_sensor or seen.size:
            values[name] = column
    known_us = [] if before is None else [before.time_us]
    return Telemetry(epoch_us, np.concatenate([np.array(known_us, dtype=np.int64), fresh.time_us]), values), after


def sampling_s(time_us: NDArray[np.int64], before: Position | None) -> float:
    """Return the usual distance of samples."""
    if time_us.size > 10 or before is None:
        return float(np.median(np.diff(time_us))) / 1e6 if time_us.size > 1 else 60.0
    return before.sampling_s
