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

import numpy as np

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
    cut = np.clip(series, -SPIKE, SPIKE)
    nis = nis_score(np.clip(series, -BOUND, BOUND) ** 2, np.ones(series.size))
    slope = slope_score(cut)
    count = np.minimum(np.arange(1, series.size + 1), TREND_WINDOW)
    mean = np.abs(windowed(cut, TREND_WINDOW)) / np.sqrt(count)
    bias = cusum(cut) * (thresholds.open / thresholds.cusum)
    score, lasting = np.maximum.reduce([nis, bias, slope]), np.maximum.reduce([nis, mean, slope])
    return score[past.size :], lasting[past.size :]


def nis_score(squares: FloatArray, freedom: FloatArray) -> FloatArray:
    """Return the score of the sum of ``squares`` over a window in which chi-square has the sum of ``freedom``."""
    total, count = windowed(squares, NIS_WINDOW), windowed(freedom, NIS_WINDOW)
    spread = 2.0 / (9.0 * np.maximum(count, 1.0))
    return np.where(count > 0, (np.cbrt(total / np.maximum(count, 1.0)) - (1.0 - spread)) / np.sqrt(spread), 0.0)


def cusum(series: FloatArray) -> FloatArray:
    """Return the greater of both one-sided CUSUMs over the last ``CUSUM_WINDOW`` samples, (n_times,)."""
    total, steps = np.concatenate([[0.0], np.cumsum(series)]), np.arange(series.size + 1)
    sides = [_rise(sign * total - ALLOWANCE * steps) for sign in (1.0, -1.0)]
    return np.maximum(*sides)


def _rise(path: FloatArray) -> FloatArray:
    """Return how far a path has risen above its least value in the window, (n_times,)."""
    padded = np.concatenate([np.full(CUSUM_WINDOW, np.inf), path])
    least = np.lib.stride_tricks.sliding_window_view(padded, CUSUM_WINDOW + 1).min(axis=1)
    rise: FloatArray = (path - least)[1:]
    return rise


def slope_score(series: FloatArray) -> FloatArray:
    """Return the least-squares slope over ``TREND_WINDOW`` samples in its own standard deviations, unsigned."""
    place = np.arange(series.size, dtype=np.float64)
    count = np.minimum(place + 1.0, TREND_WINDOW)
    centre = place - (count - 1.0) / 2.0
    moment = windowed(place * series, TREND_WINDOW) - centre * windowed(series, TREND_WINDOW)
    spread = np.sqrt(count * (count**2 - 1.0) / 12.0)
    return np.where(count > 2.0, np.abs(moment) / np.maximum(spread, 1.0), 0.0)


def windowed(series: FloatArray, window: int) -> FloatArray:
    """Return the sum over each sample and the ``window - 1`` before it."""
    total = np.concatenate([[0.0], np.cumsum(series)])
    stop = np.arange(1, series.size + 1)
    summed: FloatArray = total[stop] - total[np.maximum(stop - window, 0)]
    return summed
