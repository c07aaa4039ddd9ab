"""What the readings themselves tell, whatever the model says: sensors that are stuck, quantised anew or gone.

All three count hits: a reading that repeats the one before it exactly, or a reading that is missing. How often that
happens to a healthy sensor is learned from what came before, and bounded below by what its noise and its resolution
explain: two readings with noise sigma fall on the same step q with probability q / (2 sqrt(pi) sigma) where q is small.

A run of r hits, or x of n in a window, is scored by the signed root of its deviance, sqrt(2 n KL(x/n || p)), which is
close to standard normal (P. McCullagh, J. A. Nelder, Generalized Linear Models, 2nd ed. 1989, section 2.4).
"""

import numpy as np

from twin_core._typing import BoolArray, FloatArray, Json

LEAST_RUN = 5
"""Shorter runs are no news."""
WINDOW = 60
LEAST_P, MOST_P = 2e-3, 0.999
PRIOR = 8.0
"""Hits assumed before anything was seen: until it shows otherwise, a sensor may well repeat itself or stay away."""


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
    n = hits.size
    place = np.arange(n)
    last_miss = np.maximum.accumulate(np.where(hits, -1, place)) if n else place
    run = np.where(last_miss >= 0, place - last_miss, place + 1 + state.get("run", 0))
    seen, hit = state.get("seen", 0) + place + 1, state.get("hit", 0) + np.cumsum(hits)
    probability = _bounded((PRIOR + hit - run) / (PRIOR + seen - run), least_p)
    score = np.where(run >= LEAST_RUN, np.sqrt(-2.0 * run * np.log(probability)), 0.0)
    after = {"seen": int(seen[-1]), "hit": int(hit[-1]), "run": int(run[-1])} if n else state
    return after, score, run


def excess_scores(state: Json, hits: BoolArray, least_p: FloatArray | float) -> tuple[Json, FloatArray]:
    """Return the state and the score of how many hits a window holds beyond what came before it, (n_times,)."""
    past = np.array(state.get("past", []), dtype=np.bool_)
    series = np.concatenate([past, hits])
    total = np.concatenate([[0], np.cumsum(series)])
    stop = np.arange(past.size, series.size) + 1
    start = np.maximum(stop - WINDOW, 0)
    seen, hit = state.get("seen", 0) + start, state.get("hit", 0) + total[start]
    probability = _bounded((PRIOR + hit) / (PRIOR + seen), least_p)
    size = stop - start
    share = (total[stop] - total[start]) / np.maximum(size, 1)
    score = np.where(share > probability, np.sqrt(2.0 * size * _divergence(share, probability)), 0.0)
    kept = max(series.size - WINDOW, 0)
    forgotten = {"seen": state.get("seen", 0) + kept, "hit": state.get("hit", 0) + int(total[kept])}
    return forgotten | {"past": series[kept:].astype(int).tolist()}, score


def _bounded(probability: FloatArray, least_p: FloatArray | float) -> FloatArray:
    bounded: FloatArray = np.clip(np.maximum(probability, least_p), LEAST_P, MOST_P)
    return bounded


def _divergence(share: FloatArray, probability: FloatArray) -> FloatArray:
    """Return the Kullback-Leibler divergence of two Bernoulli distributions."""
    rest = 1.0 - share
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = np.where(share > 0.0, share * np.log(share / probability), 0.0)
        miss = np.where(rest > 0.0, rest * np.log(rest / (1.0 - probability)), 0.0)
    return np.maximum(hit + miss, 0.0)
