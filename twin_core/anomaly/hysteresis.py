"""Hysteresis: one event is one interval, whatever a score does in between."""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.anomaly.thresholds import CLOSE

TOGETHER = "*"
"""What stands for the sensor of a joint anomaly; no channel can have this name."""
HOLD = 20
"""Samples below ``CLOSE`` that end an interval."""


@dataclass(frozen=True)
class Interval:
    """One anomaly as far as it is known.

    Attributes
    ----------
    sensor
        Name of the channel; ``*`` for all of them together.
    kind
        ``residual`` (too large, one-sided or trending), ``stuck``, ``quantised``, ``dropout`` or ``joint``.
    start, stop
        Instants of the first sample that opened it and of the last one that kept it open; ``stop`` is None while it
        lasts.
    score
        Greatest score in standard deviations.
    """

    sensor: str
    kind: str
    start: int
    stop: int | None
    score: float


def follow(
    state: Json, sensor: str, kind: str, time: np.ndarray, score: FloatArray, opening: float, keeping: FloatArray
) -> tuple[Json, list[Interval]]:
    """Open an interval where a score exceeds ``opening``, and close it once ``keeping`` has been quiet for a while.

    Parameters
    ----------
    state
        What the previous call returned, empty to begin.
    sensor, kind
        What the interval is called.
    time : (n_times,)
        Integer instants, increasing.
    score, keeping : (n_times,)
        What opens an interval, and what keeps it open; a score with a long memory opens nothing that is over.
    opening
        Threshold of the score.

    Returns
    -------
    state, intervals
        The state as plain data, and every interval that was opened, raised or closed.
    """
    if not state and not (score > opening).any():
        return {}, []
    current = Interval(sensor, kind, state["start"], None, state["score"]) if "start" in state else None
    loud, quiet = state.get("loud", 0), state.get("quiet", 0)
    changed: list[Interval] = []
    index = 0
    while index < score.size:
        if current is None:
            hot = np.flatnonzero((score[index:] > opening) & (keeping[index:] >= CLOSE))
            if not hot.size:
                break
            index += int(hot[0])
            current, loud, quiet = Interval(sensor, kind, int(time[index]), None, 0.0), int(time[index]), 0
        length, last_loud, quiet = _lasting(keeping[index:], quiet)
        if last_loud >= 0:
            loud = int(time[index + last_loud])
        best = max(current.score, float(score[index : index + length].max(initial=0.0)))
        index += length
        ended = quiet >= HOLD
        changed.append(Interval(sensor, kind, current.start, loud if ended else None, best))
        current = None if ended else changed[-1]
    if current is None:
        return {}, changed
    return {"start": current.start, "score": current.score, "loud": loud, "quiet": quiet}, changed


def _lasting(keeping: FloatArray, quiet: int) -> tuple[int, int, int]:
    """Return how many samples an open interval takes, the last loud one among them, and the quiet ones since then.

    ``quiet`` samples have been below the closing score already; the interval ends when there have been ``HOLD``.
    """
    loud = np.flatnonzero(keeping >= CLOSE)
    marks = np.concatenate([[-1 - quiet], loud])
    ends = marks + HOLD
    closing = np.flatnonzero(ends < np.concatenate([loud, [keeping.size]]))
    if closing.size:
        return int(ends[closing[0]]) + 1, int(marks[closing[0]]), HOLD
    return keeping.size, int(marks[-1]), keeping.size - 1 - int(marks[-1])
