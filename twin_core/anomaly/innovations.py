"""Statistics of the normalised innovation z = nu / sqrt(S) over windows; all of them are standard normal scores.

* The windowed NIS, the sum of z^2, is chi-square distributed; the cube root of Wilson and Hilferty makes it normal.
  It sees noise that grew, spikes and large jumps.
* The window-limited CUSUM, the greatest of all sums of z - k over the last samples, sees a small lasting bias.
* The windowed slope, the least-squares trend of z over its own spread, sees a drift in its beginning.
* The windowed mean tells whether a bias still lasts.

References
----------
E. B. Wilson, M. M. Hilferty, The distribution of chi-square, PNAS 17 (1931) 684-688.
E. S. Page, Continuous inspection schemes, Biometrika 41 (1954) 100-115.
T. L. Lai, Sequential changepoint detection in quality control and dynamical systems, J. R. Stat. Soc. B 57 (1995)
613-658: CUSUM limited to a window.
Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 5.4.
"""

import math

import numpy as np
from numba import njit

from twin_core._typing import FloatArray
from twin_core.anomaly.thresholds import ALLOWANCE, Thresholds

NIS_WINDOW = 20
TREND_WINDOW = 60
CUSUM_WINDOW = 120
MEMORY = CUSUM_WINDOW
"""Samples before a stretch that its statistics need."""
BOUND = 1e3
"""Normalised innovations are cut here for the NIS, so that one broken reading does not drown what follows."""
SPIKE = 5.0
"""They are cut here for the other statistics: a single spike is neither bias nor trend."""


def scores(past: FloatArray, scaled: FloatArray, thresholds: Thresholds) -> tuple[FloatArray, FloatArray]:
    """Return the greatest score after each sample, and what tells that an anomaly still lasts, both (n_times,).

    Parameters
    ----------
    past : (n_past,)
        Normalised innovations before the stretch, the last ``MEMORY`` of them.
    scaled : (n_times,)
        Normalised innovations.
    thresholds
        Bring the CUSUM to the scale of the others.
    """
    series = np.concatenate([past, scaled])
    return _scores(series, past.size, thresholds.open / thresholds.cusum)


@njit(cache=True)
def _scores(series: FloatArray, first: int, cusum_scale: float) -> tuple[FloatArray, FloatArray]:
    cut = np.minimum(np.maximum(series, -SPIKE), SPIKE)
    bounded = np.minimum(np.maximum(series, -BOUND), BOUND)
    nis = nis_score(bounded**2, np.ones(series.size), first)
    slope, bias = slope_score(cut, first), cusum(cut, first)
    score, lasting = np.empty(nis.size), np.empty(nis.size)
    for k in range(nis.size):
        begin = max(first + k + 1 - TREND_WINDOW, 0)
        window = cut[begin : first + k + 1]
        mean = abs(window.sum()) / math.sqrt(window.size)
        score[k] = max(nis[k], bias[k] * cusum_scale, slope[k])
        lasting[k] = max(nis[k], mean, slope[k])
    return score, lasting


@njit(cache=True)
def nis_score(squares: FloatArray, freedom: FloatArray, first: int = 0) -> FloatArray:
    """Return the score of the sum of ``squares`` over a window in which chi-square has the sum of ``freedom``.

    Of the samples from ``first`` on, (n_times - first,), as the other scores of a series do.
    """
    out = np.zeros(squares.size - first)
    for k in range(out.size):
        begin, stop = max(first + k + 1 - NIS_WINDOW, 0), first + k + 1
        count = freedom[begin:stop].sum()
        if count > 0.0:
            spread = 2.0 / (9.0 * max(count, 1.0))
            out[k] = (np.cbrt(squares[begin:stop].sum() / max(count, 1.0)) - (1.0 - spread)) / math.sqrt(spread)
    return out


@njit(cache=True)
def cusum(series: FloatArray, first: int = 0) -> FloatArray:
    """Return the greater of both one-sided CUSUMs over the last ``CUSUM_WINDOW`` samples, (n_times - first,)."""
    out = np.zeros(series.size - first)
    for k in range(out.size):
        up = down = 0.0
        for i in range(first + k, max(first + k - CUSUM_WINDOW, -1), -1):
            up += series[i] - ALLOWANCE
            down -= series[i] + ALLOWANCE
            out[k] = max(out[k], up, down)
    return out


@njit(cache=True)
def slope_score(series: FloatArray, first: int = 0) -> FloatArray:
    """Return the least-squares slope over ``TREND_WINDOW`` samples in its own standard deviations, unsigned."""
    out = np.zeros(series.size - first)
    for k in range(out.size):
        begin, stop = max(first + k + 1 - TREND_WINDOW, 0), first + k + 1
        count = float(stop - begin)
        if count > 2.0:
            moment, centre = 0.0, (count - 1.0) / 2.0
            for i in range(begin, stop):
                moment += (i - begin - centre) * series[i]
            out[k] = abs(moment) / math.sqrt(count * (count**2 - 1.0) / 12.0)
    return out
