"""Coarseness: what a lumped network may leave of any record, and how much more than that a name must explain."""

import numpy as np

from twin_core.discover import policy
from twin_core.discover.confirm import Trial, mean_excess


def by_chance(n_readings: int) -> float:
    """Return the variance, in units of the sensors' noise, up to which what stays of so many readings is chance."""
    return policy.VISIBLE_COARSENESS * float(np.sqrt(2.0 / n_readings))


def least_explained(beside: float, left: float, n_readings: int) -> float:
    """Return the variance that names must explain, in units of the sensors' noise.

    Parameters
    ----------
    beside
        What counts as left beside them.
    left
        What stays unexplained. Where that is more than chance leaves of ``n_readings`` independent readings, whose variance has
        a standard error of sqrt(2 / n), the network is seen to be coarse.
    n_readings
        How many there are.
    """
    shown = min(max(left / by_chance(n_readings) - 1.0, 0.0), 1.0)
    return policy.DOMINANCE * min(max(beside, shown * policy.LEAST_COARSENESS), policy.MOST_COARSENESS)


def stands(simple: Trial, rich: Trial) -> bool:
    """Return whether what was added explains so much more than what stays beside it that it would not be withdrawn."""
    left, n_readings = mean_excess(rich), rich.n_samples
    return left <= by_chance(n_readings) or mean_excess(simple) - left >= least_explained(left, left, n_readings)
