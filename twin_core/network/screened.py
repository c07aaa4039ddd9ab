"""Telemetry of a declared network, without samples that cannot be readings."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from twin_core._typing import BoolArray
from twin_core.network.doubts import doubts
from twin_core.network.spec import Interval, TwinSpec
from twin_core.quality import masked
from twin_core.quality.gaps import segmented
from twin_core.telemetry import Record


def excluded(record: Record, intervals: Sequence[Interval]) -> BoolArray:
    """Return which samples lie in an excluded interval, (n_times,)."""
    mask = np.zeros(record.time_s.size, dtype=np.bool_)
    for interval in intervals:
        if isinstance(interval.start, str) != (record.epoch_ns is not None):
            continue
        start, stop = record.locate_s(interval.start), record.locate_s(interval.stop)
        mask |= (record.time_s >= start) & (record.time_s < stop)
    return mask


def screened(spec: TwinSpec, record: Record) -> Record:
    """Return one record as :func:`all_screened` does."""
    (clean,) = all_screened(spec, [record])
    return clean


def all_screened(spec: TwinSpec, records: Sequence[Record]) -> list[Record]:
    """Return records with what cannot be readings missing, and notices that say so.

    What in all of them together is most likely a mistake is told by the first. Excluded readings stay as they are; inputs are
    looked at there too, for they drive what comes after. Channels of the orbit are computed and need no screening; records
    that were looked at before are returned as they are.
    """
    units = {name: channel.unit for name, channel in spec.channels.items()}
    clean = [
        masked(record, units, dict.fromkeys(spec.sensors, excluded(record, spec.exclude)), spec.driving_channels)
        for record in records
    ]
    fresh = [k for k, record in enumerate(records) if record.flaws is None]
    if fresh:
        first = clean[fresh[0]]
        told = dict.fromkeys([*first.notices, *doubts(spec, [clean[k] for k in fresh])])
        clean[fresh[0]] = replace(first, notices=tuple(told))
    return clean


def segments(spec: TwinSpec, records: Sequence[Record]) -> list[Record]:
    """Return records cut at every gap, and without every lapse of an input, that no fit or prediction is to step through."""
    return segmented(records, spec.driving_channels, spec.held_inputs, spec.balance_channels)
