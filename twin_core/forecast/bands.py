"""Quantiles of a mixture of Gaussians, and the band in which a whole path stays."""

import numpy as np
from numba import njit
from scipy.special import ndtr, ndtri

from twin_core._typing import Float32Array, FloatArray

CLOSE = 1e-10
"""Share of a standard deviation by which a quantile may be missed."""
SURE = 8.3
"""Standard deviations beyond which a normal distribution is 0 or 1 to rounding."""
NODES_PER_STD = 128
"""Of the tables of the normal distribution. Half a node off, Taylor's fifth term is 1e-14."""
_GRID = np.arange(-SURE - 1.0, SURE + 1.0, 1.0 / NODES_PER_STD)
_BELOW, _DENSITY = ndtr(_GRID), np.exp(-0.5 * _GRID**2) / np.sqrt(2.0 * np.pi)
MOST_HALVINGS = 200
"""Steps to a quantile: from any bracket halving comes down to rounding in half as many."""


def mixture_quantile(probability: float, std: FloatArray, deviations: FloatArray) -> FloatArray:
    """Return the quantile of an equal mixture of normal distributions, by Halley's method within a bracket.

    Parameters
    ----------
    probability
        Between 0 and 1.
    std : (n_times, ...)
        Common standard deviation, positive.
    deviations : (n_members, n_times, ...)
        Means of the members; none: one member at zero.
    """
    z = float(ndtri(probability))
    if deviations.shape[0] == 0:
        return np.asarray(z * std)
    n_times = std.shape[0]
    means = np.ascontiguousarray(deviations.reshape(deviations.shape[0], n_times, -1).T)
    out = np.empty((means.shape[0], n_times))
    _quantiles(probability, z, np.ascontiguousarray(std.reshape(n_times, -1).T), means, _BELOW, _DENSITY, out)
    return out.T.reshape(std.shape)


@njit(cache=True, nogil=True)
def _quantiles(
    probability: float,
    z: float,
    std: FloatArray,
    means: FloatArray,
    below: FloatArray,
    density: FloatArray,
    out: FloatArray,
) -> None:
    """Write the quantiles of mixtures of means (n, n_times, n_members) and std (n, n_times) to ``out``, (n, n_times).

    Each begins where the one before suggests. ``z`` is the normal quantile.
    """
    n_members = means.shape[2]
    for i in range(std.shape[0]):
        for k in range(std.shape[1]):
            own, size = means[i, k], std[i, k]
            centre = own.mean()
            low, high = own.min() + z * size, own.max() + z * size
            x = centre + z * size
            if k > 0:
                x = centre + (out[i, k - 1] - means[i, k - 1].mean()) * size / std[i, k - 1]
            x = min(max(x, low), high)
            moved = high - low
            for _ in range(MOST_HALVINGS):
                total, slope, bend = 0.0, 0.0, 0.0
                for m in range(n_members):
                    at = (x - own[m]) / size
                    if at >= SURE:
                        total += 1.0
                    elif at > -SURE:
                        place = (at + (SURE + 1.0)) * NODES_PER_STD
                        node = int(place + 0.5)
                        d = (place - node) / NODES_PER_STD
                        y, p = at - d, density[node]
                        first, second = y * d, (y * y - 1.0) * d * d
                        total += below[node] + p * d * (1.0 - first / 2.0 + second / 6.0 - y * (y * y - 3.0) * d**3 / 24.0)
                        near = p * (1.0 - first + second / 2.0 - y * (y * y - 3.0) * d**3 / 6.0)
                        slope += near
                        bend -= at * near
                excess = total / n_members - probability
                if excess > 0.0:
                    high = x
                else:
                    low = x
                # Newton's step, bent (Halley); half the bracket where it leaves that or gains little
                step = np.inf
                if slope > 0.0:
                    step = -excess * n_members / slope
                    step /= max(1.0 + 0.5 * step * bend / slope, 0.5)
                step *= size
                if not (low <= x + step <= high) or abs(step) > 0.5 * abs(moved):
                    step = 0.5 * (low + high) - x
                x += step
                # its error is of third order in the step: this one was the last but for rounding
                if abs(step) <= CLOSE * size or (abs(step) < 1e-4 * size and abs(moved) < 1e-2 * size):
                    break
                moved = step
            out[i, k] = x


def whole_path_factor(
    probability: float,
    paths_K: Float32Array,
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
    paths_K : (n_kept, n_sensors, n_draws)
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
    n_kept, n_sensors, n_draws = paths_K.shape
    rng = np.random.default_rng(1)
    if n_between > 1.0:
        up, down = (ndtri(rng.random((n_kept, n_draws)) ** (1.0 / n_between)).astype(np.float32) for _ in range(2))
    else:  # one reading: how far it lies above is how far it does not lie below
        up = rng.standard_normal((n_kept, n_draws), dtype=np.float32)
        down = -up
    members = deviations_K if deviations_K.shape[0] else np.zeros((1, n_kept, n_sensors))
    own = np.ascontiguousarray(members.transpose(1, 2, 0), dtype=np.float32)
    low, middle, high = (band.astype(np.float32) for band in bands_K)
    worst = np.full((n_sensors, n_draws), -np.inf, dtype=np.float32)
    _widest(paths_K, own, noise_K.astype(np.float32), up, down, low, middle, high, worst)
    return np.maximum(np.quantile(worst, probability, axis=1), 1.0)


@njit(cache=True, nogil=True)
def _widest(
    paths: Float32Array,
    members: Float32Array,
    noise: Float32Array,
    up: Float32Array,
    down: Float32Array,
    low: Float32Array,
    middle: Float32Array,
    high: Float32Array,
    worst: Float32Array,
) -> None:
    """Write by how many half bands each path leaves the middle at most to ``worst``, (n_sensors, n_draws)."""
    n_kept, n_sensors, n_draws = paths.shape
    n_members = members.shape[2]
    for k in range(n_kept):
        for s in range(n_sensors):
            above, below = np.float32(1.0) / (high[k, s] - middle[k, s]), np.float32(1.0) / (middle[k, s] - low[k, s])
            for first in range(0, n_draws, n_members):
                for m in range(min(n_members, n_draws - first)):
                    j = first + m
                    at = paths[k, s, j] + members[k, s, m] - middle[k, s]
                    over, under = (at + noise[s] * up[k, j]) * above, (noise[s] * down[k, j] - at) * below
                    worst[s, j] = max(worst[s, j], max(over, under))
