"""Coarseness: what a lumped network may leave of any record, and how much more than that a name must explain."""

import numpy as np

from twin_core.calibrate.containment import attempted
from twin_core.discover import policy
from twin_core.discover.confirm import Trial, mean_excess, validate


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


def foretold(simple: Trial, rich: Trial) -> float:
    """Return how much of what is asked of names remains where they foretell what they were not fitted to.

    Coarseness is explained where it was seen; what is really there is foretold. Names that leave less of the variance of that
    error than coarseness could, half of it for a dominance of two, have so much less to explain. Only where nothing else is
    named: on healthy finite elements no name foretells so well, but what a name leaves beside it is foretold by others. What
    cannot be computed is not foretold.
    """
    if simple.effects:
        return 1.0
    told = attempted(lambda: validate(simple, rich).foresight, "what names foretell", [])
    return 1.0 if told is None else min(1.0, policy.DOMINANCE * told**2)


def stands(simple: Trial, rich: Trial) -> bool:
    """Return whether what was added explains so much more than what stays beside it that it would not be withdrawn."""
    left, n_readings = mean_excess(rich), rich.n_samples
    if left <= by_chance(n_readings):
        return True
    explained, asked = mean_excess(simple) - left, least_explained(left, left, n_readings)
    return explained >= asked or explained >= asked * foretold(simple, rich)
