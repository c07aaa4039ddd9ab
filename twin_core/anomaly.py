"""Anomalies: sensors whose innovations are larger, or more one-sided, than a consistent filter allows.

Two statistics of the normalised innovation z = nu / sqrt(S) run over windows of each sensor's own samples:

* the windowed NIS, the sum of z^2 over ``NIS_WINDOW`` samples, which is chi-square distributed. The cube root of
  Wilson and Hilferty turns it into a standard normal score,
* the windowed mean, sum(z) / sqrt(n) over ``MEAN_WINDOW`` samples, standard normal by itself.

An anomaly opens where either score exceeds ``OPEN`` and closes where both have stayed below ``CLOSE`` for ``HOLD``
samples, so that one event is one interval. ``OPEN = 5.5`` is a one-sided false-alarm probability of 2e-8 per sample.

References
----------
E. B. Wilson, M. M. Hilferty, The distribution of chi-square, PNAS 17 (1931) 684-688.
Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 5.4.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, Json

NIS_WINDOW = 20
MEAN_WINDOW = 60
OPEN = 5.5
CLOSE = 3.0
HOLD = 20
"""Samples below ``CLOSE`` that end an interval."""
BOUND = 1e3
"""Normalised innovations are cut here, so that one broken reading does not drown what follows."""


@dataclass(frozen=True)
class Interval:
    """One anomaly as far as it is known.

    Attributes
    ----------
    sensor
        Name of the channel.
    start, stop
        Instants of the first and the last sample that were out of bounds; ``stop`` is None while it lasts.
    score
        Greatest score in standard deviations.
    """

    sensor: str
    start: int
    stop: int | None
    score: float


def detect(
    state: Json | None, sensors: Sequence[str], time: np.ndarray, innovation_K: FloatArray, std_K: FloatArray
) -> tuple[Json, list[Interval]]:
    """Carry detection over a stretch of innovations.

    Parameters
    ----------
    state
        What the previous call returned, or None to begin.
    sensors
        Names, (n_sensors,).
    time : (n_times,)
        Integer instants, increasing.
    innovation_K, std_K : (n_times, n_sensors)
        Innovations and their predicted standard deviations; NaN where missing.

    Returns
    -------
    state, intervals
        The state as plain data, and every interval that was opened, raised or closed.
    """
    known = state or {}
    after: Json = {}
    intervals: list[Interval] = []
    for column, sensor in enumerate(sensors):
        scaled = innovation_K[:, column] / std_K[:, column]
        valid = np.isfinite(scaled)
        after[sensor], found = _follow(known.get(sensor, {}), sensor, time[valid], scaled[valid])
        intervals += found
    return after, intervals


def _follow(state: Json, sensor: str, time: np.ndarray, scaled: FloatArray) -> tuple[Json, list[Interval]]:
    """Carry detection of one sensor over its valid samples."""
    past = np.array(state.get("past", []), dtype=np.float64)
    bounded = np.clip(scaled, -BOUND, BOUND)
    score = scores(past, bounded)
    current = Interval(sensor, state["start"], None, state["score"]) if "start" in state else None
    loud, quiet = state.get("loud", 0), state.get("quiet", 0)
    changed: list[Interval] = []
    index = 0
    while index < score.size:
        if current is None:
            hot = np.flatnonzero(score[index:] > OPEN)
            if not hot.size:
                break
            index += int(hot[0])
            current, loud, quiet = Interval(sensor, int(time[index]), None, 0.0), int(time[index]), 0
        length, last_loud, quiet = _lasting(score[index:], quiet)
        if last_loud >= 0:
            loud = int(time[index + last_loud])
        best = max(current.score, float(score[index : index + length].max(initial=0.0)))
        index += length
        ended = quiet >= HOLD
        changed.append(Interval(sensor, current.start, loud if ended else None, best))
        current = None if ended else changed[-1]
    after: Json = {"past": np.concatenate([past, bounded])[1 - MEAN_WINDOW :].tolist()}
    if current is not None:
        after |= {"start": current.start, "score": current.score, "loud": loud, "quiet": quiet}
    return after, changed


def _lasting(score: FloatArray, quiet: int) -> tuple[int, int, int]:
    """Return how many samples an open interval takes, the last loud one among them, and the quiet ones since then.

    ``quiet`` samples have been below the closing score already; the interval ends when there have been ``HOLD``.
    """
    loud = np.flatnonzero(score >= CLOSE)
    marks = np.concatenate([[-1 - quiet], loud])
    ends = marks + HOLD
    closing = np.flatnonzero(ends < np.concatenate([loud, [score.size]]))
    if closing.size:
        return int(ends[closing[0]]) + 1, int(marks[closing[0]]), HOLD
    return score.size, int(marks[-1]), score.size - 1 - int(marks[-1])


def scores(past: FloatArray, scaled: FloatArray) -> FloatArray:
    """Return the greater of both scores after each sample, (n_times,).

    Parameters
    ----------
    past : (n_past,)
        Normalised innovations before the stretch, at most ``MEAN_WINDOW - 1`` of them.
    scaled : (n_times,)
        Normalised innovations.
    """
    series = np.concatenate([past, scaled])
    squares = _windowed(series**2, NIS_WINDOW)
    count = np.minimum(np.arange(1, series.size + 1), NIS_WINDOW)
    spread = 2.0 / (9.0 * count)
    nis_score = (np.cbrt(squares / count) - (1.0 - spread)) / np.sqrt(spread)
    count = np.minimum(np.arange(1, series.size + 1), MEAN_WINDOW)
    mean_score = np.abs(_windowed(series, MEAN_WINDOW)) / np.sqrt(count)
    return np.maximum(nis_score, mean_score)[past.size :]


def _windowed(series: FloatArray, window: int) -> FloatArray:
    """Return the sum over each sample and the ``window - 1`` before it."""
    total = np.concatenate([[0.0], np.cumsum(series)])
    stop = np.arange(1, series.size + 1)
    return total[stop] - total[np.maximum(stop - window, 0)]
