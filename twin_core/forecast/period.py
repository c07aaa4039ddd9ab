"""Does a channel repeat itself? Its period from the autocorrelation, and whether one cycle is really like the next."""

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import fdtr

from twin_core._typing import FloatArray

SIGNIFICANCE = 0.05
"""A period is told where cycles without one would resemble each other as closely in at most this share of
records. A period too many costs little: the bands contain what repeating missed."""
LEAST_CYCLES = 3
"""Two pairs of successive cycles: one alone may be chance."""
MOST_POINTS = 32_768
"""The grid on which a period is looked for; it is refined below the grid's spacing afterwards."""
LEAST_POINTS = 4
"""Of a cycle: fewer show no shape."""
SAME = 0.02
"""Autocorrelations this close to the best one are no worse: of a period and its multiples the shortest is meant. A square
wave whose period lies half a grid spacing off loses 0.02 at 100 points a period; chance adds 1 / sqrt(n_points)."""


@dataclass(frozen=True)
class Period:
    """A period, s, and the p-value of the test that cycles are alike."""

    period_s: float
    p_value: float


def find_period(time_s: FloatArray, column: FloatArray, *, held: bool) -> Period | None:
    """Return the period of a channel; None where it has none that the samples show.

    The candidate is the shortest lag at which the autocorrelation peaks as high as anywhere. It is tested on whole
    cycles, counted back from the last sample: were they not alike, half the mean square of the difference of two
    successive ones would be at least the variance within them (equal to it for white noise, three times it for a random
    walk). Their ratio is compared with Fisher's F. A cycle counts for as many independent samples as Bartlett's formula
    makes of its autocorrelation; differences that share a cycle count for 1 / 1.5 each; and as the best of many lags is
    tested, the p-value is multiplied by the number of independent ones among them.

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
    found = _peak(series)
    if found is None:
        return None
    lag, r = found
    n_cycles = int(series.size / lag + 0.1)  # one that lacks a tenth is cut to the rest, like all others
    if n_cycles < LEAST_CYCLES:
        return None
    edges = np.maximum(series.size - np.rint(lag * np.arange(n_cycles, -1, -1)).astype(int), 0)
    length = int(np.diff(edges).min())
    cycles = np.stack([series[stop - length : stop] for stop in edges[1:]])
    change, within = 0.5 * ((cycles[1:] - cycles[:-1]) ** 2).mean(), cycles.var(axis=1).mean()
    if within <= 0.0:
        return None
    independent = lag / (1.0 + 2.0 * (r[1 : int(0.5 * lag) + 1] ** 2).sum())
    freedom = independent * (n_cycles - 1) / 1.5, independent * n_cycles
    n_lags = max(1.0, independent * n_cycles / LEAST_CYCLES)
    p_value = float(min(1.0, n_lags * fdtr(*freedom, change / within)))
    return Period(float(lag) * spacing_s, p_value) if p_value <= SIGNIFICANCE else None


def values_at(time_s: FloatArray, column: FloatArray, wanted_s: FloatArray, *, held: bool) -> FloatArray:
    """Return a channel at any times: the last sample before where held, else interpolated; the ends hold beyond."""
    if not held:
        return np.interp(wanted_s, time_s, column)
    return column[np.maximum(np.searchsorted(time_s, wanted_s + 1e-6, side="right") - 1, 0)]


def _peak(series: FloatArray) -> tuple[float, FloatArray] | None:
    """Return the lag, in grid spacings, of the shortest of the highest peaks, and the autocorrelation; None without any."""
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
    enough = r[peaks] >= 1.0 - 1.25 * (1.0 - r[peaks].max()) - SAME - 1.0 / np.sqrt(n)
    first = lag = float(peaks[np.argmax(enough)])
    for multiple in range(1, int(0.5 * n / first) + 1):  # a peak at k periods tells the period k times as finely
        near = round(multiple * lag) + np.arange(-3, 4)
        alike = np.array([-((series[k:] - series[:-k]) ** 2).mean() for k in near])  # ends do not bend it as they do r
        top = 1 + int(np.argmax(alike[1:-1]))
        lag = (near[top] + _vertex(alike[top - 1 : top + 2])) / multiple
        if abs(lag - first) > 0.1 * first:  # the peaks are no multiples of one lag
            return None
    return lag, r


def _vertex(three: FloatArray) -> float:
    """Return where a parabola through three neighbours peaks, relative to the middle one."""
    curve = three[0] - 2.0 * three[1] + three[2]
    return 0.0 if curve >= 0.0 else float(np.clip(0.5 * (three[0] - three[2]) / curve, -0.5, 0.5))
