"""Limits: when a channel leaves the range where it should stay, and when a forecast says that it will."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin_core._typing import FloatArray, Json

REPEATS = 2
"""So many readings in a row beyond a limit raise an alarm, and so many well inside it end it: one alone may be a bit error."""
NOISES = 3.0
"""The dead band in standard deviations of the noise: an alarm ends only when readings have come back by so much."""
LEAST_BAND = 0.5
"""The dead band in the channel's own unit, where no noise is declared."""

Side = Literal["low", "high"]


@dataclass(frozen=True)
class Crossing:
    """A stay beyond a limit: from the first reading there to the first one that is back, None while it lasts.

    ``worst`` is the reading farthest beyond, in the channel's own unit.
    """

    start: int
    stop: int | None
    worst: float


def watch(
    state: Json, bound: float, side: Side, band: float, time: np.ndarray, values: FloatArray
) -> tuple[Json, list[Crossing]]:
    """Follow the readings of one channel along one limit; any cut into stretches gives the same crossings.

    Parameters
    ----------
    state
        What the previous call returned, empty to begin.
    bound, side
        The limit; readings beyond it are above (``high``) or below (``low``).
    band
        By so much readings must come back before the alarm ends.
    time : (n_times,)
        Integer instants, increasing.
    values : (n_times,)
        Readings in the unit of the bound; NaN where missing.

    Returns
    -------
    state, crossings
        The state as plain data, and every crossing that began, went on or ended.
    """
    sign = 1.0 if side == "high" else -1.0
    present = np.isfinite(values)
    instants, excess = time[present], sign * (values[present] - bound)
    ends = {False: excess > 0.0, True: excess < -band}
    run, first = int(state.get("run", 0)), state.get("first")
    start, worst = state.get("start"), float(state.get("worst", 0.0))
    found: list[Crossing] = []
    at = 0
    while True:
        turn, run, first = _turn(ends[start is not None], at, run, first, instants)
        stop = excess.size if turn is None else turn + 1
        if start is not None and stop > at:
            worst = max(worst, float(excess[at:stop].max()))
            found.append(Crossing(start, first if turn is not None else None, bound + sign * worst))
        if turn is None:
            break
        if start is None:
            start, begin = first, turn - REPEATS + 1
            worst = max(float(excess[max(begin, 0) : stop].max()), state.get("last", -np.inf) if begin < 0 else -np.inf)
            found.append(Crossing(int(start or 0), None, bound + sign * worst))
        else:
            start = None
        at, run, first = stop, 0, None
    last = float(excess[-1]) if excess.size else state.get("last")
    return {"run": run, "first": first, "start": start, "worst": worst, "last": last}, _latest(found)


def _turn(
    hits: np.ndarray, at: int, run: int, first: int | None, instants: np.ndarray
) -> tuple[int | None, int, int | None]:
    """Return where the next run of ``REPEATS`` hits ends, with the length of the run there and the instant of its first hit."""
    misses = np.flatnonzero(~hits[at:]) + at
    runs = np.concatenate([[at - 1 - run], misses])  # a run begins behind each miss
    stops = np.concatenate([misses, [hits.size]])
    long = np.flatnonzero(stops - runs - 1 >= REPEATS)
    place = int(long[0]) if long.size else runs.size - 1
    begin, length = int(runs[place]) + 1, int(stops[place] - runs[place]) - 1
    opened = first if begin < at else int(instants[begin]) if begin < hits.size else None
    if long.size:
        return begin + REPEATS - 1, REPEATS, opened
    return None, length, opened if length else None


def _latest(found: list[Crossing]) -> list[Crossing]:
    """Return the last word on each crossing."""
    return list({crossing.start: crossing for crossing in found}.values())


@dataclass(frozen=True)
class Ahead:
    """When a forecast reaches a limit, in its own seconds; None where it does not within the horizon.

    ``expected_s`` is when every second future has, ``earliest_s`` and ``latest_s`` when 5 % and 95 % of them have.
    """

    expected_s: float | None
    earliest_s: float | None
    latest_s: float | None


def reaches(time_s: FloatArray, quantiles: Mapping[float, FloatArray], bound: float, side: Side) -> Ahead:
    """Return when a forecast reaches a limit.

    Parameters
    ----------
    time_s : (n_times,)
        Seconds from now, increasing.
    quantiles
        Probability -> (n_times,) in the unit of the bound; 0.05, 0.5 and 0.95 at least.
    bound, side
        The limit.
    """

    def first_s(probability: float) -> float | None:
        quantile = 1.0 - probability if side == "high" else probability
        excess = (quantiles[round(quantile, 9)] - bound) * (1.0 if side == "high" else -1.0)
        beyond = np.flatnonzero(excess >= 0.0)
        if not beyond.size:
            return None
        at = int(beyond[0])
        if at == 0:
            return float(time_s[0])
        share = -excess[at - 1] / (excess[at] - excess[at - 1])
        return float(time_s[at - 1] + share * (time_s[at] - time_s[at - 1]))

    return Ahead(first_s(0.5), first_s(0.05), first_s(0.95))
