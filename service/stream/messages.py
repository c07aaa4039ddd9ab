"""Stretches of a twin's stream: numbered messages, kept as arrays until somebody reads them."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from service.instants import format_instant, format_instants, now_us
from service.store.events import Event
from service.store.residuals import Residuals

Json = dict[str, Any]


class Stretch(Protocol):
    """Consecutive messages of a stream."""

    @property
    def seqs(self) -> NDArray[np.int64]:
        """Their numbers, increasing."""

    def messages(self, after_seq: int, count: int) -> Iterator[Json]:
        """Yield the first ``count`` after a number, or all if there are fewer."""


@dataclass(frozen=True)
class SampleStretch:
    """Samples as they were stored: (n_times,) numbers and instants, (n_channels, n_times) values."""

    channels: tuple[str, ...]
    seqs: NDArray[np.int64]
    time_us: NDArray[np.int64]
    values: NDArray[np.float64]

    def messages(self, after_seq: int, count: int) -> Iterator[Json]:
        """Yield one message per sample, without the channels that it lacks."""
        first = int(np.searchsorted(self.seqs, after_seq, side="right"))
        times = format_instants(self.time_us[first : first + count])
        for offset, time in enumerate(times, start=first):
            column = self.values[:, offset].tolist()
            values = {name: v for name, v in zip(self.channels, column, strict=True) if v == v}
            yield {"type": "sample", "seq": int(self.seqs[offset]), "time": time, "values": values}


@dataclass(frozen=True)
class ResidualStretch:
    """Residuals of one model version."""

    sensors: tuple[str, ...]
    residuals: Residuals

    @property
    def seqs(self) -> NDArray[np.int64]:
        """Their numbers."""
        return self.residuals.seq

    def messages(self, after_seq: int, count: int) -> Iterator[Json]:
        """Yield one message per assimilated sample."""
        found = self.residuals
        first = int(np.searchsorted(found.seq, after_seq, side="right"))
        times = format_instants(found.time_us[first : first + count])
        for offset, time in enumerate(times, start=first):
            column = found.innovation_K[:, offset].tolist()
            nis = float(found.nis[offset])
            yield {
                "type": "residual",
                "seq": int(found.seq[offset]),
                "time": time,
                "residual_K": {s: v for s, v in zip(self.sensors, column, strict=True) if v == v},
                "nis": nis if nis == nis else None,
                "model_version": found.version,
            }


@dataclass(frozen=True)
class EventStretch:
    """Jobs, models and anomalies."""

    events: tuple[Event, ...]

    @property
    def seqs(self) -> NDArray[np.int64]:
        """Their numbers."""
        return np.array([event.seq for event in self.events], dtype=np.int64)

    def messages(self, after_seq: int, count: int) -> Iterator[Json]:
        """Yield one message per event."""
        for event in islice((event for event in self.events if event.seq > after_seq), count):
            head = {"type": event.type, "seq": event.seq, "time": format_instant(event.time_us)}
            yield head | {name: value for name, value in event.body.items() if name not in head}


def dropped(first_seq: int, last_seq: int) -> Json:
    """Return the message that tells a reader what it missed."""
    return {
        "type": "dropped",
        "seq": last_seq,
        "time": format_instant(now_us()),
        "first_seq": first_seq,
        "last_seq": last_seq,
        "count": last_seq - first_seq + 1,
    }
