"""What the readings themselves tell, whatever the model says: sensors that are stuck, quantised anew or gone.

All three count hits: a reading that repeats the one before it exactly, or a reading that is missing. How often that
happens to a healthy sensor is learned from what came before, and bounded below by what its noise and its resolution
explain: two readings with noise sigma fall on the same step q with probability q / (2 sqrt(pi) sigma) where q is small.

A run of r hits, or x of n in a window, is scored by the signed root of its deviance, sqrt(2 n KL(x/n || p)), which is
close to standard normal (P. McCullagh, J. A. Nelder, Generalized Linear Models, 2nd ed. 1989, section 2.4).
"""

import math

import numpy as np
from numba import njit

from twin_core._typing import BoolArray, FloatArray, Json

LEAST_RUN = 5
"""Shorter runs are no news."""
WINDOW = 60
LEAST_P, MOST_P = 2e-3, 0.999
PRIOR = 8.0
"""Hits assumed before anything was seen: until it shows otherwise, a sensor may well repeat itself or stay away."""


@njit(cache=True)
def repeats(carried: FloatArray, reading: FloatArray, std_K: FloatArray) -> tuple[BoolArray, BoolArray, FloatArray]:
    """Return which samples can repeat the reading before, and of those which do and how probable that is at least.

    A reading that was masked has no standard deviation of its own, yet a stuck sensor is known by it: the one before holds.

    Parameters
    ----------
    carried : (3,)
        The last reading, the last standard deviation and the finest step so far (NaN, NaN, inf to begin), carried in place.
    reading, std_K : (n_times,)
        NaN where missing.
    """
    last, std, finest = carried
    valid = np.zeros(reading.size, dtype=np.bool_)
    hits, least_p = np.zeros(reading.size, dtype=np.bool_), np.zeros(reading.size)
    n = 0
    for k in range(reading.size):
        std = std_K[k] if math.isfinite(std_K[k]) else std
        if math.isfinite(reading[k]) and math.isfinite(std):
            step = abs(reading[k] - last)
            valid[k] = True
            hits[n] = not step > 0.0  # the very first reading has none before it and is no news either
            least_p[n] = (finest if math.isfinite(finest) else 0.0) / (2.0 * math.sqrt(math.pi) * std)
            if step > 0.0:
                finest = min(finest, step)
            last = reading[k]
            n += 1
    carried[:] = last, std, finest
    return valid, hits[:n].copy(), least_p[:n].copy()


def run_scores(state: Json, hits: BoolArray, least_p: FloatArray | float) -> tuple[Json, FloatArray, FloatArray]:
    """Return the state, the score of the run that ends at each sample, and the lengths of these runs.

    Parameters
    ----------
    state
        What the previous call returned, empty to begin.
    hits : (n_times,)
        Which samples hit.
    least_p : (n_times,) or number
        Least probability of a hit of a healthy sensor.
    """
    counts = np.array([state.get(name, 0) for name in ("seen", "hit", "run")])
    score, run = _run_scores(counts, hits, least_p + np.zeros(hits.size))
    return dict(zip(("seen", "hit", "run"), counts.tolist(), strict=True)) if hits.size else state, score, run


@njit(cache=True)
def _run_scores(counts: np.ndarray, hits: BoolArray, least_p: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Return scores and lengths of runs; samples seen, hits and the present run in ``counts`` are carried in place."""
    score, runs = np.zeros(hits.size), np.zeros(hits.size, dtype=np.int64)
    seen, hit, run = counts
    for k in range(hits.size):
        seen += 1
        hit += hits[k]
        run = run + 1 if hits[k] else 0
        runs[k] = run
        if run >= LEAST_RUN:
            probability = _bounded((PRIOR + hit - run) / (PRIOR + seen - run), least_p[k])
            score[k] = math.sqrt(-2.0 * run * math.log(probability))
    counts[:] = seen, hit, run
    return score, runs


def excess_scores(state: Json, hits: BoolArray, least_p: FloatArray | float) -> tuple[Json, FloatArray]:
    """Return the state and the score of how many hits a window holds beyond what came before it, (n_times,)."""
    past = np.array(state.get("past", []), dtype=np.bool_)
    series = np.concatenate([past, hits])
    seen, hit = state.get("seen", 0), state.get("hit", 0)
    score = _excess_scores(series, past.size, seen, hit, least_p + np.zeros(hits.size))
    kept = max(series.size - WINDOW, 0)
    forgotten = {"seen": seen + kept, "hit": hit + int(series[:kept].sum())}
    return forgotten | {"past": series[kept:].astype(int).tolist()}, score


@njit(cache=True)
def _excess_scores(series: BoolArray, first: int, seen: int, hit: int, least_p: FloatArray) -> FloatArray:
    """Return the score of each sample from ``first`` on; ``seen`` samples with ``hit`` hits came before the series."""
    score = np.zeros(series.size - first)
    earlier = hit + series[: max(first - WINDOW, 0)].sum()
    for k in range(score.size):
        begin, stop = max(first + k + 1 - WINDOW, 0), first + k + 1
        if begin > max(first - WINDOW, 0):
            earlier += series[begin - 1]
        probability = _bounded((PRIOR + earlier) / (PRIOR + seen + begin), least_p[k])
        share = series[begin:stop].sum() / (stop - begin)
        if share > probability:
            score[k] = math.sqrt(2.0 * (stop - begin) * _divergence(share, probability))
    return score


@njit(cache=True)
def _bounded(probability: float, least_p: float) -> float:
    return min(max(probability, least_p, LEAST_P), MOST_P)


@njit(cache=True)
def _divergence(share: float, probability: float) -> float:
    """Return the Kullback-Leibler divergence of two Bernoulli distributions, of a share above zero."""
    rest = 1.0 - share
    miss = rest * math.log(rest / (1.0 - probability)) if rest > 0.0 else 0.0
    return max(share * math.log(share / probability) + miss, 0.0)
