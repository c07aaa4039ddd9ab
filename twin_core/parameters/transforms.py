"""Bijections between a physical value and the unbounded number that a solver moves."""

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from scipy.special import expit


class Transform(Protocol):
    """A smooth, increasing map from the real line onto the admissible values."""

    @property
    def lowest(self) -> float:
        """The free number below which there are no further values; minus infinity for most."""
        ...

    @property
    def highest(self) -> float:
        """The free number above which there are no further values; infinite for most."""
        ...

    @property
    def step_limit(self) -> float:
        """The longest step of the free number in which a linearisation still tells something; infinite for most."""
        ...

    def to_value(self, free: float) -> float:
        """Return the physical value."""
        ...

    def to_free(self, value: float) -> float:
        """Return the unbounded number; inverse of ``to_value``."""
        ...

    def slope(self, free: float) -> float:
        """Return d value / d free, positive."""
        ...


@dataclass(frozen=True)
class Identity:
    """value = free: a quantity of either sign."""

    lowest: ClassVar[float] = -np.inf
    highest: ClassVar[float] = np.inf
    step_limit: ClassVar[float] = np.inf

    def to_value(self, free: float) -> float:
        """Return the value itself."""
        return free

    def to_free(self, value: float) -> float:
        """Return the value itself."""
        return value

    def slope(self, free: float) -> float:
        """Return one."""
        return 1.0


@dataclass(frozen=True)
class Shifted:
    """value = reference + scale * free: an instant, whose own number is too large for relative tolerances.

    It moves by one scale at once: how a response changes with an instant is told near that instant only.
    """

    reference: float
    scale: float

    lowest: ClassVar[float] = -np.inf
    highest: ClassVar[float] = np.inf
    step_limit: ClassVar[float] = 1.0

    def to_value(self, free: float) -> float:
        """Return reference + scale * free."""
        return self.reference + self.scale * free

    def to_free(self, value: float) -> float:
        """Return the distance from the reference in scales."""
        return (value - self.reference) / self.scale

    def slope(self, free: float) -> float:
        """Return the scale."""
        return self.scale


@dataclass(frozen=True)
class Bounded:
    """value = free within bounds that it may reach, as a share that falls to nothing does.

    The slope is one on a bound too, so that a standard deviation there is that of the quantity without its bound.
    """

    lower: float
    upper: float = np.inf

    step_limit: ClassVar[float] = np.inf

    @property
    def lowest(self) -> float:
        """The lower bound."""
        return self.lower

    @property
    def highest(self) -> float:
        """The upper bound."""
        return self.upper

    def to_value(self, free: float) -> float:
        """Return the number, or the bound beyond which it lies."""
        return min(max(free, self.lower), self.upper)

    def to_free(self, value: float) -> float:
        """Return the value."""
        return value

    def slope(self, free: float) -> float:
        """Return one."""
        return 1.0


FROM_ZERO = Bounded(0.0)
"""A quantity that is not negative, whose size is known: an absolute temperature. It may be nothing at all."""


@dataclass(frozen=True)
class Log:
    """value = exp(free): a positive quantity of unknown order of magnitude, within bounds that it may reach if there are any."""

    upper: float = np.inf
    lower: float = 0.0

    step_limit: ClassVar[float] = np.inf

    @property
    def lowest(self) -> float:
        """The logarithm of the lower bound."""
        return float(np.log(self.lower)) if self.lower > 0.0 else -np.inf

    @property
    def highest(self) -> float:
        """The logarithm of the upper bound."""
        return float(np.log(self.upper))

    def to_value(self, free: float) -> float:
        """Return exp(free) within the bounds, held within e^-300 and e^300 so that a wild trial step stays a number."""
        value = math.exp(min(max(free, -300.0), 300.0))  # NumPy is slow with single numbers
        return max(min(value, self.upper), self.lower)

    def to_free(self, value: float) -> float:
        """Return ln(value)."""
        return float(np.log(value))

    def slope(self, free: float) -> float:
        """Return the value itself: d exp(x) / dx."""
        return self.to_value(free)


@dataclass(frozen=True)
class LogInterval:
    """A positive value strictly between two bounds: ln(value) runs along a logistic curve."""

    lower: float
    upper: float

    lowest: ClassVar[float] = -np.inf
    highest: ClassVar[float] = np.inf
    step_limit: ClassVar[float] = np.inf

    def _span(self) -> float:
        return float(np.log(self.upper / self.lower))

    def to_value(self, free: float) -> float:
        """Return lower * (upper / lower) ** logistic(free)."""
        return float(self.lower * np.exp(self._span() * expit(free)))

    def to_free(self, value: float) -> float:
        """Return the logit of the position between the bounds; a value on a bound is moved just inside."""
        position = float(np.clip(np.log(value / self.lower) / self._span(), 1e-6, 1.0 - 1e-6))
        return float(np.log(position / (1.0 - position)))

    def slope(self, free: float) -> float:
        """Return d value / d free by the chain rule."""
        position = float(expit(free))
        return self.to_value(free) * self._span() * position * (1.0 - position)


def is_logarithmic(transform: Transform) -> bool:
    """Return whether a step of one in the free number is a change by some factor, so that values stay positive."""
    return isinstance(transform, Log | LogInterval)
