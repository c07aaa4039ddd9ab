"""One parameter: its value, unit, transform and prior."""

from dataclasses import dataclass, field, replace

from twin_core.parameters.transforms import FROM_ZERO, Identity, Log, LogInterval, Transform


@dataclass(frozen=True)
class Parameter:
    """A number of the model.

    Attributes
    ----------
    name
        Unique within a model, such as ``C:px`` or ``G:px|tank``.
    unit
        SI unit, for people.
    value
        The current physical value (a guess, until calibrated).
    transform
        Maps the solver's unbounded number to the value.
    prior_std
        Standard deviation, in the transformed number, of a weak Gaussian prior around ``value``; None = flat.
    frozen
        True where the value is known and held.
    guessed
        True where nobody declared a value, so that the data alone must tell.
    tied_to, size
        The parameter of which this one is ``size`` times the value; such a one is no unknown of its own. None for most.
    """

    name: str
    unit: str
    value: float
    transform: Transform = field(default_factory=Log)
    prior_std: float | None = None
    frozen: bool = False
    guessed: bool = False
    tied_to: str | None = None
    size: float = 1.0

    @property
    def free(self) -> float:
        """The value in the solver's coordinate."""
        return self.transform.to_free(self.value)

    def at(self, value: float) -> "Parameter":
        """Return the same parameter at another value."""
        return replace(self, value=value)


GUESS_LOG_STD = 1.0
"""Prior of a declared guess in ln: a factor e either way is one standard deviation, so that data win where they speak."""

NO_GUESS_LOG_STD = 6.0
"""Prior where nobody guessed: five orders of magnitude either way are two standard deviations."""


def positive(
    name: str,
    unit: str,
    value: float,
    *,
    bounds: tuple[float, float] | None = None,
    prior_std: float | None = GUESS_LOG_STD,
    frozen: bool = False,
    guessed: bool = False,
) -> Parameter:
    """Return a parameter that is positive (and within ``bounds``) by construction."""
    transform: Transform = Log() if bounds is None else LogInterval(*bounds)
    return Parameter(name, unit, value, transform, prior_std, frozen, guessed)


def absolute_temperature(name: str, value_K: float, *, prior_std_K: float) -> Parameter:
    """Return a temperature that is not below absolute zero, with a Gaussian prior in K around its guess.

    It may be absolute zero itself: what radiates nothing back.
    """
    return Parameter(name, "K", value_K, FROM_ZERO, prior_std_K)


def real(name: str, unit: str, value: float, *, prior_std: float | None = None, frozen: bool = False) -> Parameter:
    """Return a parameter of either sign."""
    return Parameter(name, unit, value, Identity(), prior_std, frozen)
