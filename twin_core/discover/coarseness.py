"""Coarseness: what a lumped network may leave of any record, and how much more than that a name must explain."""

from collections.abc import Callable

import numpy as np

from twin_core.calibrate.containment import attempted
from twin_core.discover import policy
from twin_core.discover.evidence import paid, validate
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
        asked *= min(1.0, policy.DOMINANCE * _foresight(*alone) ** 2)
    return amount / asked if asked > 0.0 else np.inf


def times_likely(simple: Trial, rich: Trial, shown: Callable[[], tuple[Trial, Trial] | None]) -> float:
    """Return how many times as likely effects are as coarseness may look, by log Bayes factors; zero where they do not foretell.

    Gradients within the nodes may take up all that a name explains, so that of its variance nothing is its own. What is really
    there is likelier all the same, whatever the misfit is taken for: what trajectories leave wanders at the sensors, beside
    gradients or without, and the less favourable of both counts. Coarseness looks likely by one of the two, mostly: gradients
    take up what it does, or a name makes up for that alone. The unit is by how much the log-likelihood of so many readings
    varies by chance.

    Parameters
    ----------
    simple, rich, shown
        As of :func:`times_asked`.
    """
    alone = shown()
    if alone is None or not _foresight(*alone) < policy.FORESIGHT ** len(alone[1].effects):
        return 0.0
    gains = [rich.calibration().log_posterior - simple.calibration().log_posterior]
    beside = simple.beside_gradients(), rich.beside_gradients()
    if beside[0] is not None and beside[1] is not None:
        gains.append(beside[1].log_posterior - beside[0].log_posterior)
    chance = float(np.sqrt(rich.n_samples / 2.0))
    return paid(min(gains), simple, rich, 1) / max(policy.DOMINANCE * chance, 1e-300)


def _foresight(simple: Trial, rich: Trial) -> float:
    """Return the error on what names were not fitted to, after over before; infinite where it cannot be computed."""
    told = attempted(lambda: validate(simple, rich).foresight, "what names foretell", [])
    return np.inf if told is None else told


def stands(simple: Trial, rich: Trial) -> bool:
    """Return whether what was added explains so much more than what stays beside it that it would not be withdrawn."""
    left, n_readings = mean_excess(rich), rich.n_samples
    if left <= by_chance(n_readings):
        return True
    asked = least_explained(rich.unexplained(), left, n_readings)
    return times_asked(simple, rich, asked, lambda: None if simple.effects else (simple, rich)) >= 1.0
