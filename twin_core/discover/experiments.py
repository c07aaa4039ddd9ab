"""What to do next: the experiment that would tell a finding from what the record cannot tell it from.

The last stretch of the training record is flown again in both models with one input moved at a time: where their readings
part by more than the noise, the experiment decides. Neither model is refitted, so the figures are upper bounds.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.discover.confirm import Trial
from twin_core.discover.judge import Finding
from twin_core.network.dynamics import reading_offsets_K
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

MAX_ALTERNATIVES = 3
N_KEPT = 3
DECISIVE_STD = 3.0
"""Readings that part by this many standard deviations of the noise, rms over the stretch, tell two models apart."""

PULSE_SHARES = (0.25, 0.5)
"""The part of the stretch in which an input is moved."""

WARMER_K = 10.0


@dataclass(frozen=True)
class Experiment:
    """A stretch flown with one input moved, and how far apart two models then are.

    Attributes
    ----------
    words
        What to do.
    sensor
        Where it shows most.
    apart_K, apart_std
        Rms difference of the models there, in kelvin and in standard deviations of its noise.
    """

    words: str
    sensor: str
    apart_K: float
    apart_std: float

    @property
    def decides(self) -> bool:
        """Whether the difference stands out of the noise."""
        return self.apart_std > DECISIVE_STD

    def row(self) -> Json:
        """Return it for a report."""
        return {
            "experiment": self.words,
            "sensor": self.sensor,
            "apart_K": self.apart_K,
            "apart_std": self.apart_std,
            "decides": self.decides,
        }


def separating(finding: Finding) -> list[Experiment]:
    """Return the experiments that would best tell a finding from its alternatives, the most telling first.

    An experiment is as good as it tells the finding from the alternative that it tells least; none without alternatives.
    """
    rivals = [option.trial for option in finding.alternatives[:MAX_ALTERNATIVES]]
    if not rivals:
        return []
    own = finding.judged.trial
    record = own.calibration().problem.segments[-1].record
    found = []
    for words, moved in _plans(own, record):
        parted = [_apart(own, rival, words, moved) for rival in rivals]
        if all(p is not None for p in parted):
            found.append(min((p for p in parted if p is not None), key=lambda p: p.apart_std))
    return sorted(found, key=lambda e: -e.apart_std)[:N_KEPT]


def _plans(trial: Trial, record: Record) -> Iterator[tuple[str, Record]]:
    """Yield what could be done, in words and as the record that it would be: the stretch again, with one input moved."""
    spec = trial.fit.network.spec
    span_s = float(np.ptp(record.time_s))
    yield f"a further {span_s:.0f} s like the last", record
    boundaries = {b.channel: name for name, b in spec.boundaries.items() if b.channel is not None}
    for name, column in record.values.items():
        channel = spec.channels.get(name)
        if channel is None or not np.isfinite(column).any() or name in spec.sensors:
            continue
        low, high = float(np.nanmin(column)), float(np.nanmax(column))
        if name in boundaries:
            moves = [(f"{boundaries[name]} {WARMER_K:.0f} K warmer", column + WARMER_K)]
        elif channel.kind == "power":
            moves = [(f"{name} off", np.zeros_like(column)), (f"{name} held at {high:.4g}", np.full_like(column, high))]
        elif channel.kind == "auxiliary":
            moves = [(f"{name} held at {end:.4g}", np.full_like(column, end)) for end in (low, high)]
        else:
            continue
        for (words, values), share in product(moves, PULSE_SHARES):
            during = record.time_s >= record.time_s[-1] - share * span_s
            moved = {**record.values, name: np.where(during, values, column)}
            yield f"{words} for {share * span_s:.0f} s", replace(record, values=moved)


def _apart(own: Trial, rival: Trial, words: str, record: Record) -> Experiment | None:
    """Return how far the readings of two models part over a record; None where either has no solution there."""
    pair = [_readings_K(trial, record) for trial in (own, rival)]
    if not all(np.isfinite(readings).all() for readings in pair):
        return None
    noise = own.calibration().problem.noise_K
    apart = np.sqrt(np.mean((pair[0] - pair[1]) ** 2, axis=0))
    at = int(np.argmax(apart / noise))
    return Experiment(words, own.fit.network.spec.sensors[at], float(apart[at]), float(apart[at] / noise[at]))


def _readings_K(trial: Trial, record: Record) -> FloatArray:
    """Return the readings over a record that begins where the last segment of training did, (n_samples, n_sensors)."""
    network, optimum = trial.calibration().network, trial.calibration().optimum
    values = network.parameters.values
    forcing: Forcing = build_forcing(network, record, trial.max_step_s)
    path = rollout(network, values, optimum.fit.trajectories[-1].start_K, forcing)
    read = path.at_samples(forcing.sample_step)[:, network.sensor_node]
    return np.asarray(read + reading_offsets_K(network, values, record.clock_s))
