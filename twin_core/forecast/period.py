"""Does a channel repeat itself? Its period from the autocorrelation, and whether one cycle is really like the next."""

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.stats import t as student

from twin_core._typing import FloatArray

SIGNIFICANCE = 0.01
"""A period is told where cycles without one would resemble each other as closely in at most this share of records."""
LEAST_CYCLES = 3
"""Two pairs of successive cycles: one alone has no scatter to test against."""
MOST_POINTS = 32_768
"""The grid on which a period is looked for; it is refined below the grid's spacing afterwards."""
LEAST_POINTS = 4
"""Of a cycle: fewer show no shape."""
SAME = 0.02
"""Autocorrelations this close to the best one are no worse: of a period and its multiples the shortest is meant. A square
wave whose period lies half a grid spacing off loses 0.02 at 100 points a period."""


@dataclass(frozen=True)
class Period:
    """A period, s, and the p-value of the test that cycles are alike."""

    period_s: float
    p_value: float


def find_period(time_s: FloatArray, column: FloatArray, *, held: bool) -> Period | None:
    """Return the period of a channel; None where it has none that the samples show.

    The candidate is the shortest lag at which the autocorrelation peaks as high as anywhere. It is tested on whole
    cycles, counted back from the last sample: were they not alike, the mean square of the difference of two successive
    ones would be at least the sum of the variances within them (as much for white noise, three times as much for a random
    walk). The logarithms of these ratios are compared with zero by Student's t, one-sided; as neighbouring pairs share a
    cycle, their mean is given twice the variance of independent ones, the most that such sharing can cause.

    Parameters
    ----------
    time_s, column : (n_times,)
        Samples without gaps in ``column``.
    held
        Whether a sample holds until the next one; else values are interpolated.
    """
    if time_s.size < 2 * LEAST_CYCLES or np.ptp(column) <= 0.0:
        return None
    span_s = float(time_s[-1] - time_s[0])
    spacing_s = max(float(np.median(np.diff(time_s))), span_s / (MOST_POINTS - 1))
    grid_s = time_s[-1] - spacing_s * np.arange(int(span_s / spacing_s + 1e-9) + 1)[::-1]
    series = values_at(time_s, column, grid_s, held=held)
    lag = _peak(series)
    if lag is None:
        return None
    n_cycles = int(series.size / lag)
    if n_cycles < LEAST_CYCLES:
        return None
    edges = series.size - np.rint(lag * np.arange(n_cycles, -1, -1)).astype(int)
    length = int(np.diff(edges).min())
    cycles = np.stack([series[stop - length : stop] for stop in edges[1:]])
    change = ((cycles[1:] - cycles[:-1]) ** 2).mean(axis=1)
    within = cycles.var(axis=1)
    size = np.finfo(np.float64).eps * max(float(series.var()), np.finfo(np.float64).tiny)
    ratios = np.log((change + size) / (within[1:] + within[:-1] + size))
    p_value = _p_value(ratios)
    return Period(lag * spacing_s, p_value) if p_value <= SIGNIFICANCE else None


def values_at(time_s: FloatArray, column: FloatArray, wanted_s: FloatArray, *, held: bool) -> FloatArray:
    """Return a channel at any times: the last sample before where held, else interpolated; the ends hold beyond."""
    if not held:
        return np.interp(wanted_s, time_s, column)
    return column[np.maximum(np.searchsorted(time_s, wanted_s + 1e-6, side="right") - 1, 0)]


def _peak(series: FloatArray) -> float | None:
    """Return the lag, in grid spacings, of the shortest of the highest peaks; None where there is none."""
    n = series.size
    centred = series - np.polynomial.Polynomial.fit(np.arange(n), series, 1)(np.arange(n))
    size = next_fast_len(2 * n)
    raw = irfft(np.abs(rfft(centred, size)) ** 2, size)[:n]
    if raw[0] <= 0.0:
        return None
    r = raw / raw[0] * n / np.arange(n, 0, -1)
    most = n // LEAST_CYCLES
    below = np.flatnonzero(r[: most + 1] < 0.0)
    if not below.size:
        return None
    peaks = 1 + np.flatnonzero((r[1:most] >= r[: most - 1]) & (r[1:most] >= r[2 : most + 1]))
    peaks = peaks[(peaks > below[0]) & (peaks >= LEAST_POINTS)]
    if not peaks.size or r[peaks].max() <= 0.0:
        return None
    enough = r[peaks] >= 1.0 - 1.25 * (1.0 - r[peaks].max()) - SAME
    first = lag = float(peaks[np.argmax(enough)])
    for multiple in range(1, int(0.5 * n / first) + 1):  # a peak at k periods tells the period k times as finely
        near = min(round(multiple * lag), n - 4)
        top = near - 2 + int(np.argmax(r[near - 2 : near + 3]))
        lag = (top + _vertex(r[top - 1 : top + 2])) / multiple
        if abs(lag - first) > 0.1 * first:  # the peaks are no multiples of one lag
            return None
    return lag


def _vertex(three: FloatArray) -> float:
    """Return where a parabola through three neighbours peaks, relative to the middle one."""
    curve = three[0] - 2.0 * three[1] + three[2]
    return 0.0 if curve >= 0.0 else float(np.clip(0.5 * (three[0] - three[2]) / curve, -0.5, 0.5))


def _p_value(ratios: FloatArray) -> float:
    """Return the one-sided p-value of the mean of logarithms of ratios being below zero."""
    std = float(ratios.std(ddof=1))
    mean = float(ratios.mean())
    if std <= 0.0:
        return 0.0 if mean < 0.0 else 1.0
    return float(student.cdf(mean / (std * np.sqrt(2.0 / ratios.size)), ratios.size - 1))
