"""What the noise of a sensor is, told from its own samples."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.network.spec import TwinSpec
from twin_core.quality.quantisation import quantum
from twin_core.telemetry import Record

FALLBACK_STD_K = 0.1
"""Noise assumed where a sensor has too few samples to tell."""


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

    The declared one where there is one, with the variance of quantisation (step^2 / 12) added; else estimated from second
    differences, never below what quantisation leaves: a quantised sensor that does not move is not noise-free.
    """
    stds = []
    for sensor in spec.sensors:
        columns = [r.values[sensor] for r in records if sensor in r.values]
        step_K = max((quantum(c) for c in columns), default=0.0)
        declared = spec.noise_std_K(sensor)
        estimates = [e for e in (difference_noise_K(c) for c in columns) if np.isfinite(e)]
        estimate = float(np.median(estimates)) if estimates else FALLBACK_STD_K
        counting = step_K / np.sqrt(12.0)
        # What the readings show contains their quantisation wherever they move; a datasheet's figure does not.
        std = max(estimate, counting) if declared is None else float(np.hypot(declared, counting))
        stds.append(max(std, 1e-4))
    return np.array(stds)
