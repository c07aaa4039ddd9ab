"""What the hold-out says against a verdict, in words: it chose nothing, so it may."""

from collections.abc import Mapping

from twin_core._typing import Json
from twin_core.discover.policy import FORESIGHT

WORSE_THERE = 3.0
"""A ratio of errors (rms), which decides about a notice only: a misfit of two noises makes it 2.2 by itself. Of 32 measured
splits it tells of 10 (another room, runs of other kinds than those searched), half of it would tell of 24, twice of 6."""


def doubts(
    noise_K: Mapping[str, float],
    counts: Mapping[str, int],
    before: Json,
    after: Json,
    training_K: float,
    *,
    found: bool,
) -> list[str]:
    """Return what the errors over the hold-out say against the model, as sentences without full stop.

    Parameters
    ----------
    noise_K
        Every declared sensor's noise.
    counts
        How many readings of each sensor are scored.
    before, after
        Scores over the hold-out of the declared model and of the corrected one.
    training_K
        Error of the corrected model over what was searched (rms).
    found
        Whether anything was added: otherwise both scores are those of the declared model.
    """
    return [
        *(_in_all(before, after) or _of_each_sensor(noise_K, counts, before, after) if found else ()),
        *_not_scored(counts),
        *_differs_there(after, training_K),
    ]


def _in_all(before: Json, after: Json) -> list[str]:
    """Say that the error did not fall."""
    before_K, after_K = before["rmse_K"], after["rmse_K"]
    if after_K < before_K:
        return []
    return [
        f"held-out error: {before_K:.3g} K before, {after_K:.3g} K after; it did not fall, so trust the findings only "
        "where the hold-out is known to differ from the training record"
    ]


def _of_each_sensor(noise_K: Mapping[str, float], counts: Mapping[str, int], before: Json, after: Json) -> list[str]:
    """Say at which sensors the error rose though it fell over all of them: by a share as a finding is asked for, and by more than
    their noise in the mean square, three standard errors of that of so many readings included."""
    old, new = before["per_sensor"], after["per_sensor"]
    rows = [(name, old[name]["rmse_K"], new[name]["rmse_K"]) for name in counts if name in old and name in new]
    return [
        f"held-out error of {name}: {old_K:.3g} K before, {new_K:.3g} K after; it rose while the error over all sensors fell, so "
        "check this sensor and what the model says of its node"
        for name, old_K, new_K in rows
        if new_K**2 - old_K**2 > noise_K[name] ** 2 * (1.0 + 3.0 * (2.0 / counts[name]) ** 0.5)
        and FORESIGHT * new_K > old_K
    ]


def _not_scored(counts: Mapping[str, int]) -> list[str]:
    """Say which sensors have no reading in the hold-out."""
    missing = [name for name, count in counts.items() if count == 0]
    if not missing:
        return []
    have = "has" if len(missing) == 1 else "have"
    return [
        f"{', '.join(missing)} {have} no usable reading in the hold-out: the errors told are those of the other sensors"
    ]


def _differs_there(after: Json, training_K: float) -> list[str]:
    """Say that something may have begun in the part that was kept back, which no search has seen, if it fits far worse there."""
    held_K = after["rmse_K"]
    if held_K is None or not held_K > WORSE_THERE * training_K > 0.0:
        return []
    return [
        f"the part that was kept back fits {held_K / training_K:.0f} times worse than what was searched ({held_K:.3g} K against "
        f"{training_K:.3g} K): it differs in something that no search was shown; if the spacecraft may have changed, let the "
        "search see some of it (a smaller holdout)"
    ]
