"""Where an assimilation stands, and what the filter needs to go on from there."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.store.checkpoints import Checkpoint
from service.store.samples import Samples
from service.twins.registry import Entry
from service.workbench.interface import Telemetry

Json = dict[str, Any]
_KEPT = ("seq", "state", "held", "detector", "recent_us")

RECENT = 12
"""So many of the last instants tell the usual distance of samples."""
FAR = 10.0
"""In usual distances: a lone sample that lies further ahead of the others may be of a wrong clock."""


@dataclass(frozen=True)
class Position:
    """Where the assimilation stands: the last assimilated sample, its state, and the inputs that hold there.

    ``seq`` is the number at which the stream stood when the archive was read up to here, ``recent_us`` are the last
    instants, this one included.
    """

    time_us: int
    seq: int
    n_samples: int
    state: Json
    held: dict[str, float]
    detector: Json
    recent_us: list[int]

    @property
    def sampling_s(self) -> float:
        """The usual distance of samples."""
        return float(np.median(np.diff(self.recent_us))) / 1e6 if len(self.recent_us) > 1 else 60.0

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> "Position":
        """Return the position that a checkpoint describes."""
        body = checkpoint.body
        return cls(checkpoint.time_us, n_samples=checkpoint.n_samples, **{name: body[name] for name in _KEPT})

    def checkpoint(self) -> Checkpoint:
        """Return the checkpoint that describes this position."""
        return Checkpoint(self.time_us, self.n_samples, {name: getattr(self, name) for name in _KEPT})


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


def next_count(time_us: NDArray[np.int64], longest_gap_us: float) -> int:
    """Return how many of the next samples are assimilated together: none beyond a long gap, of which a step begins."""
    return int(min(np.flatnonzero(np.diff(time_us) > longest_gap_us) + 1, default=time_us.size))


def is_far(time_us: NDArray[np.int64], before: Position | None, longest_gap_us: float) -> bool:
    """Return whether the last sample lies far ahead of all others: it may be that only its clock is wrong."""
    steps = np.diff(np.concatenate([np.array([] if before is None else before.recent_us, dtype=np.int64), time_us]))
    reach_us = min(longest_gap_us, FAR * np.median(steps[:-1])) if steps.size > 1 else longest_gap_us
    return steps.size > 0 and bool(steps[-1] > reach_us)
