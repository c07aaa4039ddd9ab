"""Quantiles of a mixture of Gaussians, and the band in which a whole path stays."""

from collections.abc import Collection
from functools import lru_cache

import numpy as np
from numba import njit
from scipy.special import ndtr, ndtri

from twin_core._typing import Float32Array, FloatArray

CLOSE = 1e-10
"""Share of a standard deviation by which a quantile may be missed."""
NEAR = 1e-3
"""A step of Halley's method shorter than this leaves an error of its third power, about."""
SURE = 8.3
"""Standard deviations beyond which a normal distribution is 0 or 1 to rounding."""
NODES_PER_STD = 128
"""Of the tables of the normal distribution. Half a node off, Taylor's fifth term is 1e-14."""
_GRID = np.arange(-SURE - 1.0, SURE + 1.0, 1.0 / NODES_PER_STD)
_BELOW, _DENSITY = ndtr(_GRID), np.exp(-0.5 * _GRID**2) / np.sqrt(2.0 * np.pi)
MOST_HALVINGS = 200
"""Steps to a quantile: from any bracket halving comes down to rounding in half as many."""

KEPT_ROWS = 1024
"""So many instants' drawn numbers are kept, 2 MB: drawing them again gives the same."""


def mixture_quantiles(
    probabilities: Collection[float], std: FloatArray, deviations: FloatArray
) -> dict[float, FloatArray]:
    """Return quantiles of an equal mixture of normal distributions, by Halley's method within a bracket.

    Parameters
    ----------
    probabilities
        Between 0 and 1.
    std : (n_times, ...)
        Common standard deviation, positive.
    deviations : (n_members, n_times, ...)
        Means of the members; none: one member at zero.

    Returns
    -------
    dict
        Probability -> (n_times, ...).
    """
    if deviations.shape[0] == 0:
        return {p: np.asarray(ndtri(p) * std) for p in probabilities}
    n_times = std.shape[0]
    means = np.ascontiguousarray(deviations.reshape(deviations.shape[0], n_times, -1).T)
    centre, size = means.mean(axis=2), np.ascontiguousarray(std.reshape(n_times, -1).T)
    made = {}
    for p in probabilities:
        out = np.empty(centre.shape)
        _quantiles(p, float(ndtri(p)), size, means, centre, _BELOW, _DENSITY, out)
        made[p] = out.T.reshape(std.shape)
    return made


@njit(cache=True, nogil=True)
def _mixture(
    x: float, means: FloatArray, inverse: float, below: FloatArray, density: FloatArray
) -> tuple[float, float, float]:
    """Return the sums over members of Phi, phi and phi' at (x - mean) * inverse, by Taylor's series from the tables."""
    total, slope, bend = 0.0, 0.0, 0.0
    for m in range(means.size):
        at = (x - means[m]) * inverse
        if at >= SURE:
            total += 1.0
        elif at > -SURE:
            place = (at + (SURE + 1.0)) * NODES_PER_STD
            node = int(place + 0.5)
            d = (place - node) / NODES_PER_STD
            y, dd = at - d, d * d
            third = y * (y * y - 3.0) * dd * d
            total += below[node] + density[node] * d * (1.0 - y * d / 2.0 + (y * y - 1.0) * dd / 6.0 - third / 24.0)
            near = density[node] * (1.0 - y * d + (y * y - 1.0) * dd / 2.0 - third / 6.0)
            slope += near
            bend -= at * near
    return total, slope, bend


@njit(cache=True, nogil=True)
def _quantiles(
    probability: float,
    z: float,
    std: FloatArray,
    means: FloatArray,
    centre: FloatArray,
    below: FloatArray,
    density: FloatArray,
    out: FloatArray,
) -> None:
    """Write the quantiles of mixtures of means (n, n_times, n_members) and std (n, n_times) to ``out``, (n, n_times).

    Each search begins where the two quantiles before point to. ``z`` is the normal quantile, ``centre`` the mean of the means.
    """
    n_members = means.shape[2]
    for i in range(std.shape[0]):
        before, ahead = z, z
        for k in range(std.shape[1]):
            own, size = means[i, k], std[i, k]
            low, high, moved = -np.inf, np.inf, np.inf
            x = centre[i, k] + ahead * size
            for _ in range(MOST_HALVINGS):
                total, slope, bend = _mixture(x, own, 1.0 / size, below, density)
                excess = total / n_members - probability
                if excess > 0.0:
                    high = x
                else:
                    low = x
                step, close = np.inf, NEAR
                if slope > 0.0:
                    newton = -excess * n_members / slope
                    step = size * newton / max(1.0 + 0.5 * newton * bend / slope, 0.5)
                if not (np.isfinite(step) and low <= x + step <= high and abs(step) <= 0.5 * abs(moved)):
                    # no member's own quantile lies beyond all of them
                    low, high = max(low, own.min() + z * size), min(high, own.max() + z * size)
                    step, close = 0.5 * (low + high) - x, CLOSE
                x += step
                if abs(step) <= close * size:
                    break
                moved = step
            out[i, k] = x
            here = (x - centre[i, k]) / size
            before, ahead = here, 2.0 * here - before if k > 0 else here


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
    up, down = _noises(n_kept, n_draws, n_between)
    members = deviations_K if deviations_K.shape[0] else np.zeros((1, n_kept, n_sensors))
    own = np.ascontiguousarray(members.transpose(1, 2, 0), dtype=np.float32)
    low, middle, high = (band.astype(np.float32) for band in bands_K)
    worst = np.full((n_sensors, n_draws), -np.inf, dtype=np.float32)
    _widest(paths_K, own, noise_K.astype(np.float32), up, down, low, middle, high, worst)
    return np.maximum(np.quantile(worst, probability, axis=1), 1.0)


@lru_cache(maxsize=2)
def _noises(n_kept: int, n_draws: int, n_between: float) -> tuple[Float32Array, Float32Array]:
    """Return by how many standard deviations the largest of so many noises lies above, and one below, (n_kept, n_draws)."""
    if n_between <= 1.0:  # one reading: how far it lies above is how far it does not lie below
        noise = normals(1, n_kept, n_draws)
        return noise, -noise
    rng = np.random.default_rng(1)
    up, down = (ndtri(rng.random((n_kept, n_draws)) ** (1.0 / n_between)).astype(np.float32) for _ in range(2))
    return up, down


def normals(seed: int, n_rows: int, n_columns: int) -> Float32Array:
    """Return standard normal numbers, (n_rows, n_columns): the same ones for a seed, whatever the number of rows."""
    if n_rows <= KEPT_ROWS:
        return _kept_normals(seed, n_columns)[:n_rows]
    return np.random.default_rng(seed).standard_normal((n_rows, n_columns), dtype=np.float32)


@lru_cache(maxsize=2)
def _kept_normals(seed: int, n_columns: int) -> Float32Array:
    return np.random.default_rng(seed).standard_normal((KEPT_ROWS, n_columns), dtype=np.float32)


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
