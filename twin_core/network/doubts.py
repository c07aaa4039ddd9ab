"""What cannot be, or hardly, in telemetry and declaration together: units, signs, nodes that nothing reaches."""

from collections.abc import Iterator, Sequence

import numpy as np

from twin_core._typing import FloatArray
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.network.quantities import guess_or
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record

LIKELY_K = (150.0, 400.0)
"""Where the median of nearly every spacecraft's and laboratory's temperature lies."""

TOO_MUCH = 100.0
"""A step of heat that would move its node so many times as fast as it ever moves is taken for a unit that is wrong by 1000;
a guessed capacity that is wrong by ten is not."""


def doubts(spec: TwinSpec, records: Sequence[Record]) -> tuple[str, ...]:
    """Return a sentence for everything that is most likely a mistake in the declaration of a channel or a node.

    Parameters
    ----------
    spec
        The declared network.
    records
        Segments of telemetry in SI, without samples that are no readings; judged together.
    """
    return (*_temperatures(spec, records), *_powers(spec, records), *_unread(spec), *isolated(spec))


def _unread(spec: TwinSpec) -> Iterator[str]:
    for name, channel in spec.channels.items():
        if channel.kind == "power" and name not in spec.balance_channels:
            yield f"no load reads the power '{name}': if it heats a node, declare that as a load"


def isolated(spec: TwinSpec) -> tuple[str, ...]:
    """Return a sentence for every node that has neither a coupling nor a load."""
    return tuple(
        f"node '{name}' has no coupling and no load: nothing can change its temperature; declare what does"
        for name in unreached(spec)
    )


def unreached(spec: TwinSpec) -> tuple[str, ...]:
    """Return the nodes that have neither a coupling nor a load."""
    fed = {load.node for load in spec.loads} | {heater.node for heater in spec.heaters}
    return tuple(node for node in uncoupled(spec) if node not in fed)


def uncoupled(spec: TwinSpec) -> tuple[str, ...]:
    """Return the nodes that nothing is declared to couple to another one or to a boundary."""
    joined = {end for conductor in spec.conductors for end in conductor.between}
    joined |= {end for coupling in spec.radiation for end in coupling.between}
    joined |= {radiator.node for radiator in spec.radiators}
    return tuple(node.id for node in spec.nodes if node.id not in joined)


def _temperatures(spec: TwinSpec, records: Sequence[Record]) -> Iterator[str]:
    for name, column in _present(spec, records, "temperature"):
        unit, median_K = spec.channels[name].unit, float(np.median(column))
        own = median_K - ZERO_CELSIUS_K if unit == "degC" else median_K
        if unit == "K" and median_K < LIKELY_K[0] and LIKELY_K[0] < median_K + ZERO_CELSIUS_K < LIKELY_K[1]:
            yield f"channel '{name}' is declared in K and reads {own:.4g} in the median: if that is degC, declare it so"
        if (
            unit == "degC"
            and median_K > LIKELY_K[1]
            and LIKELY_K[0] < own < LIKELY_K[1]
            and _others_lower(spec, records, name)
        ):
            yield f"channel '{name}' is declared in degC and reads {own:.4g} in the median: if that is K, declare it so"


def _others_lower(spec: TwinSpec, records: Sequence[Record], name: str) -> bool:
    """Return whether no other temperature in degC is as high but those that look like K too, or all do."""
    medians = [float(np.median(c)) for n, c in _present(spec, records, "temperature") if n != name]
    return all(median < LIKELY_K[1] or median - ZERO_CELSIUS_K > LIKELY_K[0] for median in medians)


def _powers(spec: TwinSpec, records: Sequence[Record]) -> Iterator[str]:
    for name, column in _present(spec, records, "power"):
        unit = spec.channels[name].unit
        if column.max() <= 0.0 and column.min() < 0.0:
            span = f"{column.min():.4g} to {column.max() + 0.0:.4g} {unit}"
            yield f"channel '{name}' is a power that is never positive ({span}): check its sign"
        ratio = _too_fast(spec, records, name) if unit == "W" else 0.0
        if ratio > TOO_MUCH:
            yield (
                f"channel '{name}' would move its node {ratio:.0f} times as fast as it ever moves: if it reads mW, convert it"
                " to W; or correct the node's capacity"
            )


def _too_fast(spec: TwinSpec, records: Sequence[Record], channel: str) -> float:
    """Return how many times a channel's largest step of heat exceeds what moves its nodes; 0 where nothing tells."""
    intervals_s = np.concatenate([np.diff(record.time_s) for record in records])
    ratios = [0.0]
    for load in spec.loads:
        node = next(node for node in spec.nodes if node.id == load.node)
        capacity = guess_or(node.capacity_J_per_K, 0.0)
        if load.channel != channel or load.gain or load.table or load.factor or capacity == 0.0:
            continue
        heat_W = load.weight * _largest_step(records, channel)
        seen_K = max((_largest_step(records, s) for s in node.sensors), default=0.0)
        if seen_K > 0.0 and intervals_s.size:
            ratios.append(heat_W * float(np.median(intervals_s)) / capacity / seen_K)
    return max(ratios)


def _largest_step(records: Sequence[Record], channel: str) -> float:
    """Return the largest change of a channel from one sample to the next within a segment; 0 where it has none."""
    steps = [np.abs(np.diff(column)) for column in _samples(records, channel)]
    return float(max((step.max() for step in steps if step.size), default=0.0))


def _samples(records: Sequence[Record], channel: str) -> Iterator[FloatArray]:
    """Yield the samples of a channel in each segment that has it, without the missing ones."""
    for record in records:
        if channel in record.values:
            yield record.values[channel][np.isfinite(record.values[channel])]


def _present(spec: TwinSpec, records: Sequence[Record], kind: str) -> Iterator[tuple[str, FloatArray]]:
    """Yield the used channels of one kind that have samples, without the missing ones."""
    for name in spec.used_channels:
        if spec.channels[name].kind != kind:
            continue
        column = np.concatenate([np.empty(0), *_samples(records, name)])
        if column.size:
            yield name, column
