"""Units as control systems spell them -> units of a twin. What is not in the table is refused, never guessed."""

from dataclasses import dataclass

_SPELLINGS: dict[str, tuple[str, float, float]] = {
    **dict.fromkeys(("K", "kelvin", "Kelvin", "degK"), ("K", 1.0, 0.0)),
    **dict.fromkeys(("degC", "°C", "C", "Celsius", "celsius", "deg C", "degrees C", "Cel"), ("K", 1.0, 273.15)),
    **dict.fromkeys(("W", "watt", "Watt", "watts", "Watts"), ("W", 1.0, 0.0)),
    "mW": ("W", 1.0e-3, 0.0),
    "kW": ("W", 1.0e3, 0.0),
    **dict.fromkeys(("percent", "%", "pct"), ("percent", 1.0, 0.0)),
}
"""Spelling -> base unit, factor and offset: base = factor * value + offset."""


@dataclass(frozen=True)
class Conversion:
    """Turns a number of one unit into one of another: factor * value + offset."""

    factor: float = 1.0
    offset: float = 0.0

    def __call__(self, value: float) -> float:
        """Return the number in the other unit."""
        return value if self.factor == 1.0 and self.offset == 0.0 else self.factor * value + self.offset


def conversion(given: str | None, wanted: str | None) -> Conversion | None:
    """Return how to convert numbers of ``given`` into ``wanted``; None where they do not fit or one is not stated.

    Examples
    --------
    >>> round(conversion("°C", "K")(20.0), 6)
    293.15
    >>> conversion("V", "K") is None
    True
    """
    if given == wanted or wanted is None:
        return Conversion()
    if given not in _SPELLINGS or wanted not in _SPELLINGS:
        return None
    base, factor, offset = _SPELLINGS[given]
    other, its_factor, its_offset = _SPELLINGS[wanted]
    return Conversion(factor / its_factor, (offset - its_offset) / its_factor) if base == other else None
