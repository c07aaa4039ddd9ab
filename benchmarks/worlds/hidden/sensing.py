"""Sensors that read something else than the temperature where they are."""

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.worlds.hidden.base import Draft, Effect, Scene


def lag_exact(series: np.ndarray, step_s: float, tau_s: float) -> np.ndarray:
    """Return the first-order lag of a series that is straight between its samples, (n,)."""
    keep = np.exp(-step_s / tau_s)
    late = tau_s / step_s * (1.0 - keep)
    found = series.astype(float).copy()
    for i in range(1, series.size):
        found[i] = keep * found[i - 1] + (late - keep) * series[i - 1] + (1.0 - late) * series[i]
    return found


def _read(s: Scene, name: str, change: Callable[[np.ndarray, np.ndarray], np.ndarray], **more: Any) -> Effect:
    """Return a fault of one sensor: (instants, its column) -> what it reads."""
    column = s.craft.nodes.index(name)

    def reading(times: np.ndarray, seen: np.ndarray) -> np.ndarray:
        found = seen.copy()
        found[:, column] = change(times, seen[:, column])
        return found

    return Effect({"sensor": f"T_{name}"}, reading=reading, **more)


def sensor_bias(s: Scene) -> Draft:
    """Draw a sensor that reads too much or too little from an instant on."""
    node, sign, onset = s.node(), s.sign(), s.onset()

    def make(b: float) -> Effect:
        sizes = {"b_K": sign * b, "time": onset}
        return _read(s, node, lambda t, x: x + sign * b * (t >= onset), parameters=sizes, onset_s=onset)

    return Draft(make, 1.0)


def sensor_drift(s: Scene) -> Draft:
    """Draw a sensor that drifts over the record."""
    node, sign, duration = s.node(), s.sign(), s.craft.duration_s

    def make(d: float) -> Effect:
        rate = sign * d / duration
        return _read(s, node, lambda t, x: x + rate * t, parameters={"d_K_per_s": rate})

    return Draft(make, 2.0)


def sensor_lag(s: Scene) -> Draft:
    """Draw a sensor that follows its node with a delay."""
    node = s.node()

    def make(tau_s: float) -> Effect:
        return _read(s, node, lambda t, x: lag_exact(x, float(t[1] - t[0]), tau_s), parameters={"tau_s": tau_s})

    return Draft(make, 500.0, 2.0 * s.craft.sample_s, 3600.0)
