"""A record: channels on one strictly increasing time axis, in SI, with NaN where a sample is missing."""

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.errors import TelemetryError
from twin_core.units import format_instant, parse_instant_ns

GAP_STEPS = 10_000
"""What happened in an interval of more steps than this nobody knows: what comes after it is a record of its own."""
LEAST_PART = 20
"""Parts of a record between two gaps that have fewer samples are fitted to only where there are no others."""


@dataclass(frozen=True)
class Flaw:
    """Samples of one channel, next to each other, that are no readings.

    Attributes
    ----------
    channel
        Its name.
    reason
        Why they are none: ``frozen``, ``rail``, ``sentinel`` or ``spike``.
    start_s, stop_s
        The record's own seconds of the first and the last of them.
    samples
        How many there are.
    """

    channel: str
    reason: str
    start_s: float
    stop_s: float
    samples: int


@dataclass(frozen=True, repr=False)
class Record:
    """One segment of telemetry.

    Attributes
    ----------
    time_s : (n_times,)
        Seconds, strictly increasing, counted from ``epoch_ns``; the file's own seconds where there is no epoch.
    values : channel name -> (n_times,)
        SI (K, W; percent and auxiliary units as they are); NaN is a missing sample.
    epoch_ns
        Unix nanoseconds of ``time_s = 0``; None where the record carries no dates.
    name
        Where it came from, for messages.
    notices
        What its reader should know.
    flaws
        What was masked; None where nobody has looked yet.
    """

    time_s: FloatArray
    values: Mapping[str, FloatArray]
    epoch_ns: int | None = None
    name: str = "record"
    notices: tuple[str, ...] = field(default=())
    flaws: tuple[Flaw, ...] | None = None

    def __post_init__(self) -> None:
        """Check the axis and the shapes; raise TelemetryError naming the first offender."""
        if self.time_s.ndim != 1 or self.time_s.size == 0:
            raise TelemetryError(f"{self.name}: holds no samples")
        if not np.isfinite(self.time_s).all():
            raise TelemetryError(f"{self.name}: row {int(np.argmin(np.isfinite(self.time_s))) + 1}: time is not finite")
        steps = np.diff(self.time_s)
        if (steps <= 0).any():
            row = int(np.argmax(steps <= 0)) + 2
            raise TelemetryError(f"{self.name}: row {row}: time does not increase; sort the rows, drop repeated ones")
        for channel, column in self.values.items():
            if column.shape != self.time_s.shape:
                raise TelemetryError(
                    f"{self.name}: channel '{channel}' has {column.size} samples, time has {steps.size + 1}"
                )

    def __repr__(self) -> str:
        """Tell what it holds in one line."""
        span = f"{self.present(self.time_s[0])} to {self.present(self.time_s[-1])}"
        return f"<Record {self.name}: {self.time_s.size} samples of {', '.join(self.values)}; {span}>"

    def channel(self, name: str) -> FloatArray:
        """Return one channel, (n_times,); TelemetryError if the record lacks it."""
        if name not in self.values:
            raise TelemetryError(
                f"{self.name}: channel '{name}' is missing, and the specification needs it; add its samples, or take it out "
                f"of the specification (there are {', '.join(self.values)})"
            )
        return self.values[name]

    def between(self, start_s: float, stop_s: float) -> Self:
        """Return the samples with start_s <= time_s < stop_s; TelemetryError if there are none."""
        keep = (self.time_s >= start_s) & (self.time_s < stop_s)
        return self.take(keep)

    def take(self, keep: np.ndarray) -> Self:
        """Return the samples that the mask or index ``keep`` selects."""
        values = {name: column[keep] for name, column in self.values.items()}
        return replace(self, time_s=self.time_s[keep], values=values)

    @property
    def epoch_s(self) -> float:
        """The clock at ``time_s = 0``: unix seconds of a dated record; 0 otherwise, its own seconds being the clock."""
        return 0.0 if self.epoch_ns is None else self.epoch_ns / 1e9

    @property
    def clock_s(self) -> FloatArray:
        """The samples on the clock that dated records share, (n_times,): an instant is one number in all of them."""
        return self.time_s + self.epoch_s

    def present(self, time_s: float) -> str | float:
        """Return a time in the telemetry's own form: RFC 3339 where the record is dated, else seconds."""
        return float(time_s) if self.epoch_ns is None else format_instant(self.epoch_ns + round(float(time_s) * 1e9))

    def locate_s(self, time: str | float) -> float:
        """Return the record's own seconds of a time given in either form; TelemetryError if the form does not fit."""
        if isinstance(time, str):
            if self.epoch_ns is None:
                raise TelemetryError(f"{self.name}: '{time}' is a date, the record counts seconds")
            return (parse_instant_ns(time) - self.epoch_ns) / 1e9
        return float(time)

    def parts(self, longest_s: float, held: AbstractSet[str]) -> list[Self]:
        """Return the record cut at intervals of more than ``longest_s``; ``held`` channels keep their values across."""
        return self.parts_from([0, *(np.flatnonzero(np.diff(self.time_s) > longest_s) + 1).tolist()], held)

    def parts_from(self, starts: Sequence[int], held: AbstractSet[str]) -> list[Self]:
        """Return the record cut before each of some samples, the first of them 0; ``held`` channels keep their values across."""
        if len(starts) == 1:
            return [self]
        stops, last, parts = [*starts[1:], self.time_s.size], dict.fromkeys(held, np.nan), []
        for first, stop in zip(starts, stops, strict=True):
            part = self.take(np.arange(first, stop))
            for name in held & self.values.keys():
                column = part.values[name]
                if np.isnan(column[0]):
                    column[0] = last[name]
                finite = column[np.isfinite(column)]
                last[name] = float(finite[-1]) if finite.size else np.nan
            parts.append(part)
        return parts


def cut_at_gaps(records: Sequence[Record], held: AbstractSet[str]) -> list[Record]:
    """Return records without intervals of more than ``GAP_STEPS`` usual ones, and without scraps between such gaps.

    A fit would otherwise step through a gap, however long: one sample from a clock that is wrong by a century is enough.
    """
    parts = [part for record in records for part in _uninterrupted(record, held)]
    if len(parts) == len(records):
        return parts
    return [part for part in parts if part.time_s.size >= LEAST_PART] or [max(parts, key=lambda part: part.time_s.size)]


def _uninterrupted(record: Record, held: AbstractSet[str]) -> list[Record]:
    if record.time_s.size < 2:
        return [record]
    return record.parts(GAP_STEPS * float(np.median(np.diff(record.time_s))), held)


def one_of_each(whole: BoolArray, stride: int) -> IntArray:
    """Return one position of each ``stride`` samples, (n_samples / stride,): a record thinned so that no channel is lost.

    The first of them where all channels that count were read, as ``whole`` (n_samples,) tells, so that the step is even. Where
    channels report one after another, the position moves on from one to the next ``stride``, so that each has its turn.
    """
    first = np.arange(0, whole.size, stride)
    return np.minimum(first + np.where(whole[first], 0, np.arange(first.size) % stride), whole.size - 1)
