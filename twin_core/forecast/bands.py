"""Quantiles of a mixture of Gaussians, and the band in which a whole path stays."""

import numpy as np
from scipy.optimize.elementwise import find_root
from scipy.special import ndtr, ndtri

from twin_core._typing import FloatArray, IntArray

CLOSE = 1e-12
"""Probability by which a quantile may be missed; far below what rounding of readings could show."""
ROUNDING = 1e-9
"""Share of a standard deviation by which the bounds of a quantile are widened: equal members leave nothing between them."""
AT_ONCE = 2_000_000
"""Terms of the mixture that are evaluated together."""


def mixture_quantile(probability: float, std: FloatArray, deviations: FloatArray) -> FloatArray:
    """Return the quantile of an equal mixture of normal distributions, by Chandrupatla's method (SciPy).

    Parameters
    ----------
    probability
        Between 0 and 1.
    std : (...)
        Common standard deviation, positive.
    deviations : (n_members, ...)
        Means of the members; none: one member at zero.
    """
    if deviations.shape[0] == 0:
        return np.asarray(ndtri(probability) * std)
    flat_std, flat = std.ravel(), deviations.reshape(deviations.shape[0], -1)
    out = np.empty(flat_std.size)
    width = max(1, AT_ONCE // flat.shape[0])
    for first in range(0, out.size, width):
        part = slice(first, first + width)
        out[part] = _quantiles(probability, flat_std[part], flat[:, part])
    return out.reshape(std.shape)


def _quantiles(probability: float, std: FloatArray, means: FloatArray) -> FloatArray:
    """Return the quantile of each mixture, (n,), of means (n_members, n) and a common standard deviation (n,)."""
    reach, rounding = ndtri(probability) * std, ROUNDING * std

    def excess(here: FloatArray, which: IntArray) -> FloatArray:
        return np.asarray(ndtr((here - means[:, which]) / std[which]).mean(axis=0) - probability)

    bounds = means.min(axis=0) + reach - rounding, means.max(axis=0) + reach + rounding
    found = find_root(excess, bounds, args=(np.arange(std.size),), tolerances={"fatol": CLOSE})
    return np.asarray(found.x)


def whole_path_factor(
    probability: float,
    paths_K: FloatArray,
    deviations_K: FloatArray,
    noise_K: FloatArray,
    n_between: float,
    bands_K: tuple[FloatArray, FloatArray, FloatArray],
) -> FloatArray:
    """Return by what factor each sensor's band has to be widened for whole paths to stay in it, (n_sensors,).

    Parameters
    ----------
    probability
        Share of paths that stay inside.
    paths_K : (n_draws, n_kept, n_sensors)
        Drawn about the rollout, without noise.
    deviations_K : (n_members, n_kept, n_sensors)
        Of inputs that go on otherwise; each draw follows one of them, all equally often. None: no such.
    noise_K : (n_sensors,)
        Standard deviation of the readings, independent from one to the next.
    n_between
        How many instants each kept one stands for: of so many noises the largest counts.
    bands_K
        Low, middle and high, (n_kept, n_sensors) each, about the rollout.
    """
    rng = np.random.default_rng(1)
    low, middle, high = bands_K
    out = np.empty(noise_K.size)
    for sensor in range(noise_K.size):
        path = paths_K[:, :, sensor].copy()
        if deviations_K.shape[0]:
            path += deviations_K[np.arange(path.shape[0]) % deviations_K.shape[0], :, sensor]
        up, down = (noise_K[sensor] * ndtri(rng.random(path.shape) ** (1.0 / n_between)) for _ in range(2))
        above = (path + up - middle[:, sensor]) / (high - middle)[:, sensor]
        below = (middle[:, sensor] - path + down) / (middle - low)[:, sensor]
        out[sensor] = np.quantile(np.maximum(above, below).max(axis=1), probability)
    return np.maximum(out, 1.0)
