"""Coincidence: an event that sets in where an input changes as it does nowhere else may be what that input does."""

from collections.abc import Sequence

import numpy as np

from twin_core._typing import FloatArray
from twin_core.discover import policy
from twin_core.discover.confirm import Trial
from twin_core.effects.base import Effect
from twin_core.telemetry import Record

N_BESIDE = 3
"""Samples on either side of an instant that count as the same moment: a few tell it, whatever their number."""


def coinciding_channel(trial: Trial, effects: Sequence[Effect]) -> str | None:
    """Return a channel that changes where an event sets in, or ends, as it does nowhere else in the record; None if none does.

    A law that nobody declared, of a heater that was switched once, say, shows when it is switched, and an event at that instant
    explains it as well. Where the channel changes like this at other times too, the event has had to tell itself from the law.

    Parameters
    ----------
    trial
        With the effects at their values, and the telemetry.
    effects
        Those that are asked.
    """
    instants = [effect.values[q.name] for effect in effects for q in effect.parameter_specs() if q.instant is not None]
    if not instants:
        return None
    spec = trial.fit.network.spec
    records = [segment.record for segment in trial.fit.problem.segments]
    for name in (name for name in spec.channels if name not in spec.sensors):
        given = [record for record in records if name in record.values]
        if any(_is_outstanding(given, name, instant_s) for instant_s in instants):
            return name
    return None


def _is_outstanding(records: Sequence[Record], name: str, instant_s: float) -> bool:
    """Return whether a channel changes about an instant more than anywhere else in some records, by far."""
    here, elsewhere = 0.0, 0.0
    for record in records:
        change = _changes(record.values[name])
        beyond = np.abs(np.arange(change.size) - (np.searchsorted(record.clock_s, instant_s) - N_BESIDE))
        within = record.clock_s[0] <= instant_s <= record.clock_s[-1]
        here = max(here, float(change[beyond <= N_BESIDE].max(initial=0.0)) if within else 0.0)
        elsewhere = max(elsewhere, float(change[(beyond > 3 * N_BESIDE) | (not within)].max(initial=0.0)))
    return here > policy.DOMINANCE * elsewhere


def _changes(values: FloatArray) -> FloatArray:
    """Return by how much a channel changes over each stretch of samples that counts as one moment; gaps are held over."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size == 0:
        return np.zeros(0)
    held = values[known[np.maximum(np.searchsorted(known, np.arange(values.size), side="right") - 1, 0)]]
    return np.abs(held[2 * N_BESIDE :] - held[: -2 * N_BESIDE])
