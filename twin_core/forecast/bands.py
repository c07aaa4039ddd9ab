"""Quantiles of a mixture of Gaussians, and the band in which a whole path stays."""

import numpy as np
from scipy.special import ndtr, ndtri

from twin_core._typing import FloatArray

MOST_STEPS = 60
CLOSE = 1e-10
"""A quantile is found once a step is so small a share of the standard deviation."""
AT_ONCE = 2_000_000
"""Terms of the mixture that are evaluated together."""


def mixture_quantile(probability: float, std: FloatArray, deviations: FloatArray) -> FloatArray:
    """Return the quantile of an equal mixture of normal distributions, by Newton's method between bounds that close in.

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
    reach = ndtri(probability) * std
    low, high = means.min(axis=0) + reach, means.max(axis=0) + reach
    found = np.clip(means.mean(axis=0) + ndtri(probability) * np.hypot(std, means.std(axis=0)), low, high)
    left = np.arange(std.size)
    for _ in range(MOST_STEPS):
        here = found[left]
        scaled = (here - means[:, left]) / std[left]
        excess = ndtr(scaled).mean(axis=0) - probability
        below = excess < 0.0
        low[left], high[left] = np.where(below, here, low[left]), np.where(below, high[left], here)
        slope = np.exp(-0.5 * scaled**2).mean(axis=0) / (np.sqrt(2.0 * np.pi) * std[left])
        newton = here - excess / np.maximum(slope, 1e-300)
        inside = (newton > low[left]) & (newton < high[left])
        found[left] = np.where(inside, newton, 0.5 * (low[left] + high[left]))
        left = left[np.abs(found[left] - here) > CLOSE * std[left]]
        if left.size == 0:
            break
    return found


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
