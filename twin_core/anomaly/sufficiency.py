"""Does the declared model still suffice? A test that may be looked at after every sample, for as long as telemetry comes.

Null hypothesis: whatever came before, the next normalised innovation, cut at ±``CUT``, is ``tolerance`` off zero on average
at most. Its law is left open: scale, tails, and steps of a converter. Against it runs the likelihood, predicted one sample
ahead, of alternatives that put the mean elsewhere, over that of the law within the null that comes closest to each (universal
inference, with the null refitted at every sample). For a bounded variable with a bounded mean this ratio is
``1 + λ (±ψ - tolerance)``, one λ for each size of the alternative, and no other form is ever larger. Its expectation under
the null is at most one, whatever the law; so is that of the product over the samples, of averages, and of a wealth that is
moved between alternatives by a rule that does not look ahead. By Ville's inequality such a wealth ever exceeds 1/α with
probability α at most.

Some alternatives keep to one sign, others take that of the recent mean, which finds what comes and goes with every orbit.
An alternative may set in at any sample and end: a part of the wealth goes from nothing to every alternative
before each sample, and a part of each alternative's back (fixed share).

References
----------
L. Wasserman, A. Ramdas, S. Balakrishnan, Universal inference, PNAS 117 (2020) 16880, arXiv 1912.11436, section 8: sequential.
I. Waudby-Smith, A. Ramdas, Estimating means of bounded random variables by betting, J. R. Stat. Soc. B 86 (2024) 1,
arXiv 2010.09686. M. Larsson, A. Ramdas, J. Ruf, The numeraire e-variable and reverse information projection, arXiv 2402.18810.
M. Herbster, M. K. Warmuth, Tracking the best expert, Machine Learning 32 (1998) 151.
"""

from collections.abc import Sequence

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, Json

CUT = 3.0
"""Normalised innovations are cut here: the test is of means, and one broken reading must not decide it."""
TOLERANCE = 0.25
"""Mean of the normalised innovations, in standard deviations, that still counts as sufficient: no model is exact."""
LARGEST = 0.9
"""The largest λ as a share of what could lose everything at one sample, and the factor from one λ to the next below it."""
N_SIZES, RATIO = 4, 0.5
MEMORY = 16.0
"""Readings over which the recent mean is taken, exponentially weighted."""
SETTLING = 100.0
"""Before the n-th reading of a sensor 1 / (n + this) of what waits goes to the alternatives: the older, the more patient."""
LEAVING = 1.0 / 256.0
"""Part of each alternative that goes back before every reading."""


def sizes(tolerance: float = TOLERANCE) -> FloatArray:
    """Return λ of every alternative, (3 ``N_SIZES`` + 1,): zero for what waits, then of both signs, then of the recent one."""
    up = LARGEST / (CUT + tolerance) * RATIO ** np.arange(N_SIZES)
    return np.concatenate([[0.0], up, -up, up])


def follow_evidence(
    state: Json | None, sensors: Sequence[str], scaled: FloatArray, tolerance: float = TOLERANCE
) -> tuple[Json, FloatArray]:
    """Carry the test over a stretch of samples; any cut into stretches gives the same.

    Parameters
    ----------
    state
        What the previous call returned, or None to begin.
    sensors
        Names, (n_sensors,).
    scaled : (n_times, n_sensors)
        Normalised innovations; NaN where missing.
    tolerance
        The same in all calls.

    Returns
    -------
    state, log_evidence : (n_times,)
        The state as plain data, with the greatest log evidence so far under ``most``; and the natural logarithm of the
        e-process of all sensors, their mean. The model is refuted at level α once that exceeds log(1/α).
    """
    known = (state or {}).get("sensors", {})
    bets = sizes(tolerance)
    fresh = {"n": 0, "mean": 0.0, "log": 0.0, "shares": [1.0] + [0.0] * (bets.size - 1)}
    before = [known.get(sensor, fresh) for sensor in sensors]
    n = np.array([b["n"] for b in before], dtype=np.int64)
    mean = np.array([b["mean"] for b in before], dtype=np.float64)
    log = np.array([b["log"] for b in before], dtype=np.float64)
    shares = np.array([b["shares"] for b in before], dtype=np.float64)
    paths = _wealth(np.ascontiguousarray(scaled, dtype=np.float64), n, mean, log, shares, bets, tolerance)
    highest = paths.max(axis=1)
    total = highest + np.log(np.exp(paths - highest[:, None]).mean(axis=1))
    most = max((state or {}).get("most", 0.0), float(total.max(initial=0.0)))
    columns = (n.tolist(), mean.tolist(), log.tolist(), shares.tolist())
    rows = [dict(zip(fresh, row, strict=True)) for row in zip(*columns, strict=True)]
    return {"sensors": dict(zip(sensors, rows, strict=True)), "most": most}, total


@njit(cache=True)
def _wealth(
    scaled: FloatArray,
    n: np.ndarray,
    mean: FloatArray,
    log: FloatArray,
    shares: FloatArray,
    bets: FloatArray,
    tolerance: float,
) -> FloatArray:
    """Return the log wealth of every sensor after each sample; ``n``, ``mean``, ``log``, ``shares`` are carried in place."""
    out = np.empty(scaled.shape)
    others = bets.size - 1
    signed = 1 + 2 * N_SIZES
    for t in range(scaled.shape[0]):
        for s in range(scaled.shape[1]):
            z = scaled[t, s]
            if not np.isnan(z):
                n[s] += 1
                psi = min(max(z, -CUT), CUT)
                gone = shares[s, 0] / (n[s] + SETTLING)
                recent = 1.0 if mean[s] >= 0.0 else -1.0
                total = back = 0.0
                for k in range(1, bets.size):
                    left = LEAVING * shares[s, k]
                    back += left
                    bet = bets[k] if k < signed else recent * bets[k]
                    shares[s, k] += gone / others - left
                    shares[s, k] *= 1.0 + bet * psi - abs(bet) * tolerance
                    total += shares[s, k]
                shares[s, 0] += back - gone
                total += shares[s, 0]
                for k in range(bets.size):
                    shares[s, k] /= total
                log[s] += np.log(total)
                mean[s] += (psi - mean[s]) / MEMORY
            out[t, s] = log[s]
    return out
