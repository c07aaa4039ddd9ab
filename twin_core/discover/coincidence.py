"""When events set in: one where an input changes as it does nowhere else may be what that input does, one at an end of the
record may have been so all along."""

from collections.abc import Sequence

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.discover import policy
from twin_core.discover.trial import Trial
from twin_core.effects.base import Effect
from twin_core.effects.onset import MARGIN
from twin_core.telemetry import Record

N_BESIDE = 6
"""Samples on either side of an instant that count as the same moment: so closely have the onsets of the suites been found."""

FEWEST_BESIDE = 2
"""Samples that lie before an event and after it at least, of a record so short that ``MARGIN`` is less: the first one tells the
initial state alone."""


def coinciding_channel(trial: Trial, effects: Sequence[Effect]) -> str | None:
    """Return a channel with a lone change where an event sets in, or ends; None if there is none.

    A law that nobody declared, of a heater that was switched once, say, shows when it is switched, and an event at that instant
    explains it as well. Where the channel changes like this at other times too, the event has had to tell itself from the law.

    Parameters
    ----------
    trial
        With the effects at their values, and the telemetry.
    effects
        Those that are asked.
    """
    instants = _instants(effects)
    if not instants:
        return None
    spec = trial.fit.network.spec
    records = [segment.record for segment in trial.fit.problem.segments]
    for name in (name for name in spec.channels if name not in spec.sensors):
        for record, alone in zip(records, lone_changes(records, name), strict=True):
            clock_s = record.clock_s
            within = [t for t in instants if clock_s[0] <= t <= clock_s[-1]]
            if alone[np.searchsorted(clock_s, within)].any():
                return name
    return None


def at_an_end(trial: Trial, effects: Sequence[Effect]) -> bool:
    """Return whether an event sets in, or ends, so close to an end of the record that too little tells what was so without it.

    No event is looked for there, but a fit may move one there, or out of the record: then it describes what was so all along.

    Parameters
    ----------
    trial
        With the effects, fitted, and the telemetry.
    effects
        Those that are asked: beside heat that wanders, and along open-loop trajectories, from which they are told.
    """
    if not _instants(effects):
        return False
    places = {effect.place for effect in effects}
    instants = _instants([*effects, *(effect for effect in trial.present_effects if effect.place in places)])
    segments = trial.fit.problem.segments
    seen_s = np.sort(np.concatenate([s.record.clock_s[s.valid.any(axis=1)] for s in segments]))
    before = np.searchsorted(seen_s, instants)
    return bool((np.minimum(before, seen_s.size - before) < _fewest(seen_s.size)).any())


def _fewest(n_samples: int) -> int:
    """Return how many samples must lie before what happens and after it, or too little tells what it did."""
    return max(round(MARGIN * (n_samples - 1)), FEWEST_BESIDE)


def _instants(effects: Sequence[Effect]) -> list[float]:
    """Return the instants at which effects set in or end."""
    return [effect.values[q.name] for effect in effects for q in effect.parameter_specs() if q.instant is not None]


def lone_changes(records: Sequence[Record], name: str) -> list[BoolArray]:
    """Return where a channel changes more than anywhere else in all records, by far: (n_samples,) for each record."""
    changes = [_changes(r.values[name]) if name in r.values else np.zeros(r.time_s.size) for r in records]
    found = []
    for own in changes:
        others = max((float(c.max(initial=0.0)) for c in changes if c is not own), default=0.0)
        apart = np.full(
            2 * N_BESIDE + 1, others
        )  # stretches that end before this one begins, or begin after it has ended
        before = np.maximum.accumulate(np.concatenate([apart, own]))[: own.size]
        after = np.maximum.accumulate(np.concatenate([apart, own[::-1]]))[: own.size][::-1]
        found.append(np.maximum(before, after) < own / policy.LONE_CHANGE)
    return found


def _changes(values: FloatArray) -> FloatArray:
    """Return by how much a channel changes over the stretch about each sample, (n_samples,); gaps are held over.

    What it does at the ends of the record is left out: too little tells what follows from it.
    """
    known = np.flatnonzero(np.isfinite(values))
    if known.size == 0:
        return np.zeros(values.size)
    at = np.arange(values.size)
    held = values[known[np.maximum(np.searchsorted(known, at, side="right") - 1, 0)]]
    first = min(_fewest(at.size), at[-1])
    last = max(first, at[-1] - first)
    return np.asarray(np.abs(held[np.clip(at + N_BESIDE, first, last)] - held[np.clip(at - N_BESIDE, first, last)]))
