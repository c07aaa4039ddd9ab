"""What of a record is no reading: every detector in its order, and the record without it."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.quality.frozen import frozen_channel, frozen_rows
from twin_core.quality.held import held_repeats
from twin_core.quality.runs import runs_of
from twin_core.quality.sentinels import sentinels
from twin_core.quality.spikes import spikes
from twin_core.telemetry import Flaw, Record
from twin_core.wording import counted

FROZEN, HELD, RAIL, SENTINEL, SPIKE = "frozen", "held", "rail", "sentinel", "spike"
TEMPERATURE_UNITS = ("K", "degC")


@dataclass(frozen=True)
class Screening:
    """Which samples of a record are no readings.

    Attributes
    ----------
    masks : channel -> reason -> (n_times,)
        Channels and reasons with no such sample are absent; a sample has one reason at most.
    """

    masks: Mapping[str, Mapping[str, BoolArray]]

    def without(self, ignored: Mapping[str, BoolArray]) -> "Screening":
        """Return the screening with nothing to say about some samples of some channels, (n_times,) each."""
        masks: dict[str, dict[str, BoolArray]] = {}
        for channel, reasons in self.masks.items():
            heard = ~ignored[channel] if channel in ignored else np.True_
            masks[channel] = {reason: mask & heard for reason, mask in reasons.items() if (mask & heard).any()}
        return Screening({channel: reasons for channel, reasons in masks.items() if reasons})


def screen(
    time_s: FloatArray,
    columns: Mapping[str, FloatArray],
    units: Mapping[str, str | None],
    inputs: Collection[str] = (),
) -> Screening:
    """Look for samples that cannot be readings.

    Parameters
    ----------
    time_s : (n_times,)
        Seconds, strictly increasing.
    columns : channel -> (n_times,)
        SI, NaN where missing.
    units : channel -> unit
        The unit in which each channel was written; K and degC tell the temperatures. A command may hold for ever and
        switch at once: only temperatures spike and freeze on their own.
    inputs
        Channels that no node is read by: what they hold, they may well be meant to.

    Returns
    -------
    Screening
    """
    masks: dict[str, dict[str, BoolArray]] = {channel: {} for channel in columns}
    left = {channel: np.array(column, dtype=np.float64) for channel, column in columns.items()}

    def take(channel: str, reason: str, found: BoolArray) -> None:
        if found.any():
            masks[channel][reason] = masks[channel].get(reason, np.zeros_like(found)) | found
            left[channel][found] = np.nan

    for channel, column in columns.items():
        take(channel, SENTINEL, sentinels(time_s, column, units.get(channel)))
    for channel in columns:
        if units.get(channel) in TEMPERATURE_UNITS and channel not in inputs:
            take(channel, HELD, held_repeats(left[channel]))
    rows = frozen_rows(list(left.values()))
    for channel in columns:
        take(channel, FROZEN, rows & np.isfinite(left[channel]))
    for channel in columns:
        if units.get(channel) in TEMPERATURE_UNITS:
            frozen = frozen_channel(left[channel])
            railed = _at_an_extreme(left[channel], frozen)
            take(channel, RAIL, railed)
            take(channel, FROZEN, frozen & ~railed)
            take(channel, SPIKE, spikes(time_s, left[channel]))
    return Screening({channel: reasons for channel, reasons in masks.items() if reasons})


def _at_an_extreme(column: FloatArray, frozen: BoolArray) -> BoolArray:
    """Return which frozen readings hold the largest or the smallest value that the channel ever shows, more than once."""
    railed = np.zeros_like(frozen)
    if frozen.any():
        for rail in (np.nanmax(column), np.nanmin(column)):
            held = frozen & (column == rail)
            if runs_of(held)[0].size > 1:
                railed |= held
    return railed


def masked(
    record: Record,
    units: Mapping[str, str | None],
    ignored: Mapping[str, BoolArray] | None = None,
    inputs: Collection[str] = (),
) -> Record:
    """Return a record without samples that cannot be readings: they are missing, and its notices say so.

    A record that was looked at before is returned as it is.

    Parameters
    ----------
    record
        In SI.
    units : channel -> unit
    inputs
        As :func:`screen` takes them.
    ignored : channel -> (n_times,)
        Samples that take no part in anything: they are left as they are.
    """
    if record.flaws is not None:
        return record
    screening = screen(record.time_s, record.values, units, inputs)
    if ignored is not None:
        screening = screening.without(ignored)
    values = dict(record.values)
    for channel, reasons in screening.masks.items():
        values[channel] = np.where(np.any(list(reasons.values()), axis=0), np.nan, record.values[channel])
    flaws = tuple(_flaws(record, screening))
    return replace(record, values=values, flaws=flaws, notices=(*record.notices, *_notices(record, screening)))


def unmasked(record: Record) -> Record:
    """Return a record of which every sample counts as a reading."""
    return replace(record, flaws=())


def spans_of(reason: str, mask: BoolArray) -> list[tuple[int, int]]:
    """Return first sample and sample after the last of the spans of a mask; what is held is one, however many repeats it has."""
    first, stop = (ends.tolist() for ends in runs_of(mask))
    return [(first[0], stop[-1])] if reason == HELD and first else list(zip(first, stop, strict=True))


def _flaws(record: Record, screening: Screening) -> Iterator[Flaw]:
    for channel, reasons in screening.masks.items():
        for reason, mask in reasons.items():
            for first, stop in spans_of(reason, mask):
                samples = int(mask[first:stop].sum())
                yield Flaw(channel, reason, float(record.time_s[first]), float(record.time_s[stop - 1]), samples)


def _notices(record: Record, screening: Screening) -> Iterator[str]:
    """Yield one sentence for each reason and number of samples, naming the channels that share them."""
    shared: dict[tuple[str, int, int], list[str]] = {}
    for channel, reasons in screening.masks.items():
        for reason, mask in reasons.items():
            shared.setdefault((reason, int(mask.sum()), int(np.argmax(mask))), []).append(channel)
    for (reason, samples, first), channels in shared.items():
        names = ", ".join(f"'{channel}'" for channel in channels)
        each = "" if len(channels) == 1 else "each of "
        yield (
            f"{record.name}: {counted(samples, 'reading')} of {each}{names} left out as {_WORDS[reason]},"
            f" the first at {record.present(record.time_s[first])}"
        )


_WORDS = {
    FROZEN: "frozen (repeated for longer than quantisation explains)",
    HELD: "repeats until a slower sensor reported again",
    RAIL: "stuck at a rail (the end of the range)",
    SENTINEL: "markers of missing samples",
    SPIKE: "spikes (off what the readings on both sides allow)",
}
