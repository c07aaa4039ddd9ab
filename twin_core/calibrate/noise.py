"""What the noise of a sensor is, told from its own samples."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtr

from twin_core._typing import FloatArray
from twin_core.network.spec import TwinSpec
from twin_core.quality.quantisation import quantum, resolution
from twin_core.telemetry import Record

FALLBACK_STD_K, LEAST_STD_K = 0.1, 1e-4
"""Noise assumed where a sensor has too few samples to tell, and the smallest that one is believed to have."""

ROUNDING_K = 1e-9
"""What the arithmetic of readings leaves of differences between equal codes: no noise."""

DYNAMICS = 1.5
"""Ratio of the noise that readings tell to that of what a model leaves of them, beyond which the former holds more than noise.
On ten splits of rigs, houses and spacecraft the latter is 0.87 to 1.28 of the former, quantisation aside; on none of 50 seeded
spacecraft it is below two thirds. 30 s apart on a board that warms in two minutes it is a sixth."""


UNEVEN = 0.05
"""Intervals that differ from their median by more than this share of it, for more than one in twenty, are uneven."""
UNEVEN_ORDER = 4
"""Order of the divided differences there: their points lie further apart, where a curve of second order is no longer one."""

WINSORISED = 2.0
"""Differences of quantised readings, in units of their own scale, beyond which they count no more. Noise under steps of 1 to 6
times itself is told to 4 % at 1.5, 1 % at 2, 6 % at 2.5 and at 3; one far outlier in ten raises it by 19, 31, 60 and 208 %."""
SETTLED, MOST_ROUNDS = 1e-4, 100
"""Relative change of that scale at which it has settled, and rounds at most."""


def difference_noise_K(time_s: FloatArray, column: FloatArray, quantum_K: float = 0.0) -> float:
    """Return the white-noise standard deviation of readings (n_times,), robust against events; NaN if too short.

    From second differences; where the sampling is uneven from divided differences, since a steady slope leaves nothing of
    these, whatever the intervals. A difference that touches a missing reading is left out. The median of differences that are
    multiples of ``quantum_K`` is such a multiple itself, whatever the noise: there a winsorised mean square tells.
    """
    steps_s = np.diff(time_s)
    if not steps_s.size or np.mean(np.abs(steps_s / np.median(steps_s) - 1.0) > UNEVEN) <= UNEVEN:
        differences = np.diff(column, 2) / np.sqrt(6.0)
    else:
        differences = _divided_differences(time_s, column)
    seen = differences[np.isfinite(differences)]
    if seen.size < 8:
        return float("nan")
    if quantum_K > 0.0:
        return _winsorised_std(seen)
    std = float(np.median(np.abs(seen - np.median(seen)))) / 0.6745
    return std if std > ROUNDING_K else 0.0


def _winsorised_std(values: FloatArray) -> float:
    """Return the standard deviation of normal values with outliers among them (Huber 1981, Robust Statistics, proposal 2)."""
    most = WINSORISED
    density = np.exp(-0.5 * most**2) / np.sqrt(2.0 * np.pi)
    consistent = 2.0 * ndtr(most) - 1.0 - 2.0 * most * density + 2.0 * most**2 * ndtr(-most)
    std = float(np.sqrt(np.mean(values**2)))
    for _ in range(MOST_ROUNDS):
        before, std = std, float(np.sqrt(np.mean(np.minimum(values**2, (most * std) ** 2)) / consistent))
        if abs(std - before) <= SETTLED * before:
            break
    return std


def _divided_differences(time_s: FloatArray, column: FloatArray) -> FloatArray:
    """Return divided differences of white noise of unit variance, scaled to unit variance, (n_times - ``UNEVEN_ORDER``,).

    Their weights are the inverse products of the distances of a point to the others (Lagrange).
    """
    order = UNEVEN_ORDER
    if column.size <= order:
        return np.empty(0)
    times = sliding_window_view(time_s / np.median(np.diff(time_s)), order + 1)
    apart = times[:, :, None] - times[:, None, :] + np.eye(order + 1)
    weights = 1.0 / np.prod(apart, axis=2)
    scaled = (weights * sliding_window_view(column, order + 1)).sum(axis=1)
    return np.asarray(scaled / np.linalg.norm(weights, axis=1))


def _noise_of_changes_K(time_s: FloatArray, column: FloatArray) -> float:
    """Return the white-noise standard deviation told by the present readings that differ from the one before; NaN if too few."""
    seen = np.isfinite(column)
    time_s, column = time_s[seen], column[seen]
    changed = np.diff(column, prepend=np.nan) != 0.0
    return difference_noise_K(time_s[changed], column[changed])


def sensor_noise_K(spec: TwinSpec, records: list[Record]) -> FloatArray:
    """Return the noise standard deviation of each sensor, (n_sensors,), in K.

    The declared one where there is one, with the variance of quantisation (step^2 / 12) added; else estimated from
    differences, never below what quantisation leaves: a quantised sensor that does not move is not noise-free. Where readings
    are missing between all others, or most repeat the one before, those that change tell; of a sensor that hardly moves its
    smallest change stands for the step.
    """
    stds = []
    for sensor in spec.sensors:
        columns = [(r.time_s, r.values[sensor]) for r in records if sensor in r.values]
        quanta = [quantum(c) for _, c in columns]
        counting = max(quanta, default=0.0) / np.sqrt(12.0)
        declared = spec.noise_std_K(sensor)
        if declared is not None:  # what the readings show contains their quantisation wherever they move, this does not
            std = float(np.hypot(declared, counting))
        else:
            std = (
                max(_median(difference_noise_K(t, c, q) for (t, c), q in zip(columns, quanta, strict=True)), counting)
                or _median(_noise_of_changes_K(t, c) for t, c in columns)
                or min((step for _, c in columns if (step := resolution(c)) > 0.0), default=0.0) / np.sqrt(12.0)
                or FALLBACK_STD_K
            )
        stds.append(max(std, LEAST_STD_K))
    return np.array(stds)


def noise_beside_K(
    spec: TwinSpec, records: Sequence[Record], noise_K: FloatArray, residuals_K: Sequence[FloatArray]
) -> FloatArray:
    """Return the noise of each sensor, (n_sensors,), less the temperatures' own changes from sample to sample that are in it.

    Where samples lie so far apart that temperatures turn between them, differences of readings tell more than their noise; what
    a model leaves of the readings has lost most of these turns.

    Parameters
    ----------
    spec, records
        The declared network and its telemetry.
    noise_K : (n_sensors,)
        As :func:`sensor_noise_K` returns it.
    residuals_K : one (n_times, n_sensors) per record
        What a fit has left.
    """
    found = noise_K.copy()
    for k, sensor in enumerate(spec.sensors):
        quanta = [quantum(r.values[sensor]) if sensor in r.values else 0.0 for r in records]
        left = zip(records, residuals_K, quanta, strict=True)
        told = _median(difference_noise_K(r.time_s, column[:, k], q) for r, column, q in left)
        told = max(told, max(quanta) / np.sqrt(12.0))
        if spec.noise_std_K(sensor) is None and 0.0 < DYNAMICS * told < noise_K[k]:
            found[k] = max(told, LEAST_STD_K)
    return found


def _median(estimates: Iterable[float]) -> float:
    """Return the median of the estimates that are numbers, zero without any."""
    told = [e for e in estimates if np.isfinite(e)]
    return float(np.median(told)) if told else 0.0
