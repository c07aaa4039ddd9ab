"""The detector: every statistic of every sensor, and of all of them together, carried over stretches of samples."""

from collections.abc import Sequence
from math import isfinite

import numpy as np

from twin_core._typing import BoolArray, FloatArray, Json
from twin_core.anomaly import innovations, readings
from twin_core.anomaly.hysteresis import TOGETHER, Interval, follow
from twin_core.anomaly.thresholds import Thresholds


def detect(
    state: Json | None,
    sensors: Sequence[str],
    time: np.ndarray,
    reading: FloatArray,
    innovation_K: FloatArray,
    std_K: FloatArray,
    nis: FloatArray,
    thresholds: Thresholds | None = None,
) -> tuple[Json, list[Interval]]:
    """Carry detection over a stretch of samples; any cut into stretches gives the same intervals.

    Parameters
    ----------
    state
        What the previous call returned, or None to begin.
    sensors
        Names, (n_sensors,).
    time : (n_times,)
        Integer instants, increasing.
    reading : (n_times, n_sensors)
        As measured, in K or degC; NaN where missing.
    innovation_K, std_K : (n_times, n_sensors)
        Innovations and their predicted standard deviations; NaN where missing.
    nis : (n_times,)
        Normalised innovation squared of all sensors seen at each sample.
    thresholds
        From the false-alarm rate; the default one if absent.

    Returns
    -------
    state, intervals
        The state as plain data, and every interval that was opened, raised or closed. A joint anomaly opens only while
        no single sensor explains it.
    """
    limits = thresholds or Thresholds()
    known = (state or {}).get("sensors", {})
    after: Json = {"sensors": {}}
    intervals: list[Interval] = []
    explained = np.zeros(time.size, dtype=np.bool_)
    columns = (np.ascontiguousarray(matrix.T) for matrix in (innovation_K / std_K, reading, std_K))
    for sensor, scaled, read, std in zip(sensors, *columns, strict=True):
        one = _Sensor(sensor, known.get(sensor, {}), limits)
        one.residual(time, scaled)
        one.repeats(time, read, std)
        one.missing(time, read)
        explained |= one.busy
        after["sensors"][sensor] = one.state
        intervals += one.intervals
    seen = np.isfinite(innovation_K).sum(axis=1)
    after["joint"], found = _joint((state or {}).get("joint", {}), time, nis, seen, explained, limits)
    return after, intervals + found


class _Sensor:
    """The statistics of one sensor over one stretch."""

    def __init__(self, name: str, state: Json, limits: Thresholds) -> None:
        self._name, self._before, self._limits = name, state, limits
        self.state: Json = {}
        self.intervals: list[Interval] = []
        self.busy: BoolArray = np.zeros(0, dtype=np.bool_)

    def residual(self, time: np.ndarray, scaled: FloatArray) -> None:
        """Look at the normalised innovations."""
        valid = np.isfinite(scaled)
        past = np.array(self._before.get("past", []), dtype=np.float64)
        score, keeping = innovations.scores(past, scaled[valid], self._limits)
        self._follow("residual", time[valid], score, keeping)
        bounded = np.clip(scaled[valid], -innovations.BOUND, innovations.BOUND)
        self.state["past"] = np.concatenate([past, bounded])[-innovations.MEMORY :].tolist()
        self.busy = np.zeros(time.size, dtype=np.bool_)
        for interval in self.intervals:
            self.busy |= (time >= interval.start) & (True if interval.stop is None else time <= interval.stop)

    def repeats(self, time: np.ndarray, reading: FloatArray, std_K: FloatArray) -> None:
        """Look for readings that repeat exactly: a run of them is a stuck sensor, more than usual a coarser one."""
        before = (self._before.get("last", np.nan), self._before.get("std", np.nan), self._before.get("step", np.inf))
        carried = np.array(before, dtype=np.float64)
        valid, hits, least_p = readings.repeats(carried, reading, std_K)
        self.state |= {
            name: value
            for name, value in zip(("last", "std", "step"), carried.tolist(), strict=True)
            if isfinite(value)
        }
        self.state["stuck"], score, run = readings.run_scores(self._before.get("stuck", {}), hits, least_p)
        self._follow("stuck", time[valid], score, score)
        short = hits & (run < readings.LEAST_RUN)
        self.state["coarse"], score = readings.excess_scores(self._before.get("coarse", {}), short, least_p)
        self._follow("quantised", time[valid], score, score)

    def missing(self, time: np.ndarray, reading: FloatArray) -> None:
        """Look for a sensor that stays away; one that never came is not missed."""
        gone = np.isnan(reading)
        began = self._before.get("gone", {}).get("seen", 0) > 0
        first = 0 if began else int(np.argmin(gone)) if not gone.all() else gone.size
        self.state["gone"], score, _ = readings.run_scores(self._before.get("gone", {}), gone[first:], 0.0)
        self._follow("dropout", time[first:], score, score)

    def _follow(self, kind: str, time: np.ndarray, score: FloatArray, keeping: FloatArray) -> None:
        opened: Json = self._before.get("open", {}).get(kind, {})
        left, found = follow(opened, self._name, kind, time, score, self._limits.open, keeping)
        if left:
            self.state.setdefault("open", {})[kind] = left
        self.intervals += found


def _joint(
    state: Json, time: np.ndarray, nis: FloatArray, seen: np.ndarray, explained: BoolArray, limits: Thresholds
) -> tuple[Json, list[Interval]]:
    """Look at all sensors together: what none of them shows alone may show in their sum."""
    past, past_seen = (np.array(state.get(name, []), dtype=np.float64) for name in ("nis", "seen"))
    value = np.concatenate([past, np.where(np.isfinite(nis), nis, 0.0)])
    freedom = np.concatenate([past_seen, np.where(np.isfinite(nis), seen, 0).astype(np.float64)])
    score = innovations.nis_score(value, freedom)[past.size :]
    left, found = follow(
        state.get("open", {}), TOGETHER, "joint", time, np.where(explained, 0.0, score), limits.open, score
    )
    kept = slice(-innovations.NIS_WINDOW + 1, None)
    return {"nis": value[kept].tolist(), "seen": freedom[kept].tolist(), "open": left}, found
