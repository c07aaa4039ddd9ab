"""What the noise of a sensor is, told from its own samples."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record

FALLBACK_STD_K = 0.1
"""Noise assumed where a sensor has too few samples to tell."""


def quantum_K(column: FloatArray) -> float:
    """Return the quantisation step of a series: the smallest change that it shows, 0 where it shows many sizes.

    A series counts as quantised when nearly all of its changes are whole multiples of the smallest one.
    """
    values = column[np.isfinite(column)]
    changes = np.abs(np.diff(values))
    changes = changes[changes > 1e-9]
    if changes.size < 8:
        return 0.0
    step = float(np.quantile(changes, 0.02))
    distance = np.abs(changes / step - np.round(changes / step))
    few_levels = np.unique(np.round(values, 6)).size < 0.5 * values.size
    return step if few_levels and float(np.mean(distance < 0.12)) > 0.95 else 0.0


def difference_noise_K(column: FloatArray) -> float:
    """Return the white-noise standard deviation from second differences, robust against steps; NaN if too short."""
    second = np.diff(column, 2)
    second = second[np.isfinite(second)]
    if second.size < 8:
        return float("nan")
    spread = float(np.median(np.abs(second - np.median(second)))) / 0.6745
    return spread / np.sqrt(6.0)


def sensor_noise_K(spec: TwinSpec, records: list[Record]) -> FloatArray:
    """Return the noise standard deviation of each sensor, (n_sensors,), in K.

    The declared one where there is one, else estimated from second differences, never below what quantisation leaves
    (step / sqrt 12): a quantised sensor that does not move is not noise-free.
    """
    stds = []
    for sensor in spec.sensors:
        columns = [r.values[sensor] for r in records if sensor in r.values]
        quantum = max((quantum_K(c) for c in columns), default=0.0)
        declared = spec.noise_std_K(sensor)
        estimates = [e for e in (difference_noise_K(c) for c in columns) if np.isfinite(e)]
        estimate = float(np.median(estimates)) if estimates else FALLBACK_STD_K
        stds.append(max(declared if declared is not None else estimate, quantum / np.sqrt(12.0), 1e-4))
    return np.array(stds)
