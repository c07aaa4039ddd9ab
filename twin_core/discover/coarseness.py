"""Coarseness: what a lumped network may leave of any record, and how much more than that a name must explain."""

from collections.abc import Callable

import numpy as np

from twin_core.calibrate.containment import attempted
from twin_core.discover import policy
from twin_core.discover.evidence import validate
from twin_core.discover.trial import Trial, by_chance, explained, mean_excess


def least_explained(beside: float, left: float, n_readings: int, *, is_named: bool = True) -> float:
    """Return the variance that effects must explain, in units of the sensors' noise.

    Parameters
    ----------
    beside
        What counts as left beside them.
    left
        What stays unexplained. Where that is more than chance leaves of ``n_readings`` independent readings, whose variance has
        a standard error of sqrt(2 / n), the network is seen to be coarse.
    n_readings
        How many there are.
    is_named
        Whether names are asked: against a heat without a name, which could be all of it, whatever stays counts.
    """
    shown = min(max(left / by_chance(n_readings) - 1.0, 0.0), 1.0)
    coarseness = max(beside, shown * policy.LEAST_COARSENESS)
    return policy.DOMINANCE * (min(coarseness, policy.MOST_COARSENESS) if is_named else coarseness)


def times_asked(
    simple: Trial, rich: Trial, asked: float, shown: Callable[[], tuple[Trial, Trial] | None] = lambda: None
) -> float:
    """Return how many times as much as is asked of them effects explain; names that foretell have less to explain.

    Only where it would be too little is asked what they foretell, so that values above one do not rank them.

    Coarseness is explained where it was seen; what is really there is foretold. Names that leave less of the variance of the
    error on what they were not fitted to than coarseness could, half of it for a dominance of two, have so much less to
    explain. They must foretell it with nothing else named: what a name leaves beside it is foretold by others. What cannot be
    computed is not foretold.

    Parameters
    ----------
    simple, rich
        Trials without the effects and with them.
    asked
        Variance that they must explain, in units of the sensors' noise.
    shown
        Returns the trials without any finding and with these names alone, where what they foretell counts: not that of a heat
        without a name.
    """
    amount = explained(simple, rich)
    if amount < asked and (alone := shown()) is not None:
        told = attempted(lambda: validate(*alone).foresight, "what names foretell", [])
        asked *= 1.0 if told is None else min(1.0, policy.DOMINANCE * told**2)
    return amount / asked if asked > 0.0 else np.inf


def stands(simple: Trial, rich: Trial) -> bool:
    """Return whether what was added explains so much more than what stays beside it that it would not be withdrawn."""
    left, n_readings = mean_excess(rich), rich.n_samples
    if left <= by_chance(n_readings):
        return True
    asked = least_explained(rich.unexplained(), left, n_readings)
    return times_asked(simple, rich, asked, lambda: None if simple.effects else (simple, rich)) >= 1.0
