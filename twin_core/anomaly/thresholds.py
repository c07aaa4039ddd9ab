"""Thresholds from a false-alarm rate."""

import math
from dataclasses import dataclass, field
from statistics import NormalDist

from twin_core.errors import ModelError

FALSE_ALARM_RATE = 2e-8
"""Default probability that one statistic of a healthy sensor alarms at one sample."""
CLOSE = 3.0
"""Score below which a statistic counts as quiet again: the gap to the opening score is the hysteresis."""
ALLOWANCE = 0.5
"""Reference value of the CUSUM, in standard deviations: a lasting bias below it never adds up."""


@dataclass(frozen=True)
class Thresholds:
    """Where an anomaly opens.

    Attributes
    ----------
    rate
        Probability that one statistic of a healthy sensor alarms at one sample.
    open
        Score in standard deviations that opens an interval; every statistic is brought to this scale.
    cusum
        Decision interval of the CUSUM whose average run length between false alarms is one over the rate.
    """

    rate: float = FALSE_ALARM_RATE
    open: float = field(init=False)
    cusum: float = field(init=False)

    def __post_init__(self) -> None:
        """Derive the thresholds; ModelError if the rate would not leave room for hysteresis."""
        if not 0.0 < self.rate <= 1e-4:
            raise ModelError(f"false_alarm_rate: must be above 0 and at most 1e-4 per sample (got {self.rate:g})")
        object.__setattr__(self, "open", NormalDist().inv_cdf(1.0 - self.rate))
        object.__setattr__(self, "cusum", _decision_interval(2.0 / self.rate))


def _decision_interval(run_length: float) -> float:
    """Return the decision interval h of a one-sided CUSUM of standard normal samples for an average run length.

    Siegmund's approximation: run length = (exp(2 k b) - 2 k b - 1) / (2 k^2) with b = h + 1.166
    (D. Siegmund, Sequential Analysis, 1985, section 2.6). Solved by fixed-point iteration, which contracts.
    """
    b = 10.0
    for _ in range(60):
        b = math.log(2.0 * ALLOWANCE**2 * run_length + 2.0 * ALLOWANCE * b + 1.0) / (2.0 * ALLOWANCE)
    return b - 1.166
