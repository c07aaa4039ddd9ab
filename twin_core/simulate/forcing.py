"""Telemetry as forcing: the time steps of a rollout with inputs and boundary temperatures at both ends."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.errors import TelemetryError
from twin_core.network.formula import channels_of, evaluate, is_dated
from twin_core.network.model import Network
from twin_core.network.spec import TwinSpec
from twin_core.network.terms import Along
from twin_core.simulate.orbit_inputs import orbit_inputs
from twin_core.telemetry import Record
from twin_core.units import sun_distance_au

ENDS = np.array([0.0, 1.0])
"""Places in a step at which rates are taken: its begin and its end, between which inputs are held or linear."""


@dataclass(frozen=True)
class Forcing:
    """What drives a rollout.

    Attributes
    ----------
    epoch_s
        The clock at time 0 (``Record.epoch_s``).
    start_s
        Time of the initial state.
    step_s : (n_steps,)
    stage_time_s : (n_steps, 2)
        Begin and end of each step.
    sample_step : (n_samples,)
        Steps taken before each sample.
    boundaries_K : (n_steps, 2, n_boundaries)
        NaN where the temperature is an unknown constant.
    inputs : channel -> (n_steps, 2)
    sun_factor : (n_steps, 2)
    """

    epoch_s: float
    start_s: float
    step_s: FloatArray
    stage_time_s: FloatArray
    sample_step: IntArray
    boundaries_K: FloatArray
    inputs: Mapping[str, FloatArray]
    sun_factor: FloatArray

    @property
    def n_steps(self) -> int:
        """Number of time steps."""
        return int(self.step_s.size)

    def opening(self, n_steps: int) -> "Forcing":
        """Return the first steps, with a single sample at their end."""
        return Forcing(
            self.epoch_s,
            self.start_s,
            self.step_s[:n_steps],
            self.stage_time_s[:n_steps],
            np.array([n_steps]),
            self.boundaries_K[:n_steps],
            {name: series[:n_steps] for name, series in self.inputs.items()},
            self.sun_factor[:n_steps],
        )

    def boundaries_flat_K(self, first: int, last: int) -> FloatArray:
        """Return the boundaries at both ends of steps first..last-1, (2 n_steps, n_boundaries): there may be none."""
        return self.boundaries_K[first:last].reshape(2 * (last - first), self.boundaries_K.shape[2])

    def along(self, temperatures_K: FloatArray, boundaries_K: FloatArray, first: int, last: int) -> Along:
        """Return both ends of steps first..last-1 flattened to (2 n_steps, ...), at given temperatures."""
        window = slice(first, last)
        return Along(
            self.stage_time_s[window].ravel() + self.epoch_s,
            temperatures_K,
            boundaries_K,
            {name: series[window].ravel() for name, series in self.inputs.items()},
            self.sun_factor[window].ravel(),
        )


def at_times(record: Record, channel: str, is_held: bool, time_s: FloatArray, *, interval: IntArray) -> FloatArray:
    """Return a channel at both ends of steps: the sample that opens their interval where held, else interpolated.

    Missing samples hold the last one (or are bridged by interpolation); before the first sample its value is taken.
    """
    column = record.channel(channel)
    valid = np.isfinite(column)
    if not valid.any():
        raise TelemetryError(f"{record.name}: channel '{channel}' has no samples; the model needs it as an input")
    if not is_held:
        return np.interp(time_s, record.time_s[valid], column[valid])
    last = np.maximum.accumulate(np.where(valid, np.arange(column.size), -1))
    filled = column[np.where(last >= 0, last, np.argmax(valid))]
    return filled[interval]


def first_boundary_K(spec: TwinSpec, record: Record, boundary: str) -> float:
    """Return the temperature of a boundary where a record begins; NaN for an unknown constant."""
    declared = spec.boundaries[boundary]
    if declared.channel is None:
        return np.nan if declared.value_K is None else declared.value_K
    first = np.zeros(1, dtype=np.int64)
    return float(at_times(record, declared.channel, True, record.time_s[:1], interval=first)[0])


MOST_STEPS = 20_000_000
"""Decades of minutes; each step costs some hundred bytes."""


def build_forcing(network: Network, record: Record, max_step_s: float) -> Forcing:
    """Return the forcing of a record: every sample is a step's end, long intervals are divided.

    Parameters
    ----------
    network
        Declares boundaries, inputs and whether the Sun's distance matters.
    record
        Telemetry in SI.
    max_step_s
        Longest step allowed.

    Raises
    ------
    TelemetryError
        If the record is too long for so short a step, a channel that drives the network is missing or empty, a solar
        load meets a record without dates, or the network knows instants in another form than the record's.
    """
    spec = network.spec
    _check_clock(network, record)
    intervals = np.diff(record.time_s)
    steps = np.maximum(1.0, np.ceil(intervals / max_step_s - 1e-9))
    if steps.sum() > MOST_STEPS:
        raise TelemetryError(
            f"{steps.sum():.3g} steps of at most {max_step_s:g} s are more than {MOST_STEPS:g}; take a shorter record"
        )
    divisions = steps.astype(np.int64)
    step = np.repeat(intervals / divisions, divisions)
    interval = np.repeat(np.arange(intervals.size), divisions)
    within = np.arange(step.size) - np.repeat(np.cumsum(divisions) - divisions, divisions)
    begin = record.time_s[interval] + within * step
    stage_time = begin[:, None] + step[:, None] * ENDS
    stage_interval = np.repeat(interval[:, None], 2, axis=1)
    boundaries = np.full((step.size, 2, len(spec.boundaries)), np.nan)
    for column, boundary in enumerate(spec.boundaries.values()):
        if boundary.value_K is not None:
            boundaries[:, :, column] = boundary.value_K
        elif boundary.channel is not None:
            held = spec.channels[boundary.channel].is_held
            boundaries[:, :, column] = at_times(record, boundary.channel, held, stage_time, interval=stage_interval)
    inputs = {
        name: at_times(record, name, spec.channels[name].is_held, stage_time, interval=stage_interval)
        for name in _driving_channels(spec, record)
    } | orbit_inputs(spec, record, begin, step, ENDS)
    inputs |= _derived(spec, record, inputs, stage_time)
    sample_step = np.concatenate([[0], np.cumsum(divisions)])
    sun = _sun_factor(spec, record, stage_time)
    start = float(record.time_s[0])
    return Forcing(record.epoch_s, start, step, stage_time, sample_step, boundaries, inputs, sun)


def _check_clock(network: Network, record: Record) -> None:
    """Refuse a record whose clock is not the one in which the network's effects know their instants."""
    if network.dated is not None and network.dated != (record.epoch_ns is not None):
        known, given = ("dates", "counts seconds") if network.dated else ("seconds of a file", "carries dates")
        raise TelemetryError(
            f"{record.name}: the model knows when its effects set in as {known}, the record {given}; "
            f"give a '{'time' if network.dated else 'time_s'}' column"
        )


def _driving_channels(spec: TwinSpec, record: Record) -> tuple[str, ...]:
    """Return the channels of declared loads, and every further power or auxiliary channel that the record has."""
    declared = {load.channel for load in spec.loads} | {load.factor for load in spec.loads if load.factor is not None}
    declared |= {name for derived in spec.derived.values() for name in channels_of(derived.formula)}
    declared -= spec.orbit_channels.keys() | spec.derived.keys()
    free = {
        name
        for name, channel in spec.channels.items()
        if channel.kind != "temperature" and name in record.values and np.isfinite(record.values[name]).any()
    }
    return tuple(name for name in spec.channels if name in declared | free)


def _derived(
    spec: TwinSpec, record: Record, inputs: Mapping[str, FloatArray], time_s: FloatArray
) -> dict[str, FloatArray]:
    """Return what formulas give at both ends of steps; each may read those before it."""
    found: dict[str, FloatArray] = {}
    for name, derived in spec.derived.items():
        if is_dated(derived.formula) and record.epoch_ns is None:
            raise TelemetryError(f"{record.name}: derived.{name} needs dates; give a 'time' column in RFC 3339")
        found[name] = evaluate(derived.formula, {**inputs, **found}, time_s + record.epoch_s)
        if not np.isfinite(found[name]).all():
            at = record.present(float(time_s[~np.isfinite(found[name])][0]))
            raise TelemetryError(f"{record.name}: derived.{name} is not finite at {at}; correct its formula")
    return found


def _sun_factor(spec: TwinSpec, record: Record, time_s: FloatArray) -> FloatArray:
    """Return (1 AU / Sun distance)^2 at both ends of steps; ones where nothing is solar."""
    if not any(load.solar for load in spec.loads):
        return np.ones_like(time_s)
    if record.epoch_ns is None:
        raise TelemetryError(f"{record.name}: a solar load needs dates; give a 'time' column in RFC 3339, not 'time_s'")
    return 1.0 / sun_distance_au(record.epoch_ns, time_s) ** 2
