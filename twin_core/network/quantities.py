"""What a specification is made of: numbers within limits, names, and quantities that are known or to be found."""

import math
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator


def _not_boolean(value: Any) -> Any:
    """Refuse true and false where a number is wanted: Python would take them for 1 and 0."""
    if isinstance(value, bool):
        raise ValueError("must be a number, not true or false")
    return value


LEAST_MAGNITUDE = 1e-12
MOST_MAGNITUDE = 1e15
"""Between these a positive quantity in SI may lie, declared or calibrated; beyond them the balance cannot be computed."""


def _zero_or_magnitude(value: float) -> float:
    if value != 0.0 and not LEAST_MAGNITUDE <= value <= MOST_MAGNITUDE:
        raise ValueError(f"must be 0, or from {LEAST_MAGNITUDE:g} to {MOST_MAGNITUDE:g}")
    return value


Number = Annotated[float, BeforeValidator(_not_boolean), Field(allow_inf_nan=False)]
Positive = Annotated[float, BeforeValidator(_not_boolean), Field(gt=0, allow_inf_nan=False)]
Magnitude = Annotated[
    float,
    BeforeValidator(_not_boolean),
    Field(gt=0, allow_inf_nan=False),
    Field(ge=LEAST_MAGNITUDE, le=MOST_MAGNITUDE, allow_inf_nan=False),
]
"""A positive quantity in SI that hardware may have; beyond it the balance cannot be computed."""
MagnitudeOrNone = Annotated[
    float, BeforeValidator(_not_boolean), Field(ge=0, allow_inf_nan=False), AfterValidator(_zero_or_magnitude)
]
"""The same, or exactly nothing."""
Temperature = Annotated[float, BeforeValidator(_not_boolean), Field(ge=0, le=5000, allow_inf_nan=False)]
Fraction = Annotated[float, BeforeValidator(_not_boolean), Field(gt=0, le=1, allow_inf_nan=False)]
NAME = r"^[A-Za-z_][A-Za-z0-9_.:/-]{0,127}$"
TWIN_ID = r"^[a-z0-9][a-z0-9-]{0,62}$"
Name = Annotated[str, Field(pattern=NAME)]


class Strict(BaseModel):
    """Declared fields only, which never change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Spread = Annotated[float, BeforeValidator(_not_boolean), Field(gt=1, le=1e6, allow_inf_nan=False)]
"""The factor, up or down, that is one standard deviation of a guess."""


class Quantity(Strict):
    """A positive quantity: known (``value``: held) or unknown (``guess``: calibrated, within optional ``bounds``).

    A guess may say how far off it may be: ``spread`` is the factor of one standard deviation.
    """

    value: Magnitude | None = None
    guess: Magnitude | None = None
    bounds: tuple[Positive, Positive] | None = None
    spread: Spread | None = None

    @model_validator(mode="after")
    def _one_meaning(self) -> Self:
        if self.value is not None and (self.guess is not None or self.bounds is not None):
            raise ValueError(
                "give either 'value' (known, held) or 'guess' with optional 'bounds' (calibrated), not both"
            )
        if self.spread is not None and self.guess is None:
            raise ValueError("spread says how far a guess may be off; give 'guess' with it")
        if self.bounds is not None:
            low, high = self.bounds
            if not low < high:
                raise ValueError(f"bounds contradict each other: {low:g} is not below {high:g}")
            if self.guess is not None and not low <= self.guess <= high:
                raise ValueError(f"guess {self.guess:g} lies outside its bounds {low:g} to {high:g}")
        return self


class Tied(Quantity):
    """A quantity that may also be a known size times a shared unknown, which the specification lists under ``parameters``."""

    @property
    def tie(self) -> tuple[str, float] | None:
        """The name of the shared unknown and the size that multiplies it; None where it stands alone."""
        return self._scaled()

    scale: Name | None = None

    @model_validator(mode="after")
    def _value_with_scale(self) -> Self:
        if self.scale is not None and not self.value:
            raise ValueError("scale names a shared factor; give the 'value' that it multiplies")
        return self

    @property
    def unit(self) -> str:
        """The unit of the shared unknown."""
        return ""

    @property
    def tied_by(self) -> str:
        """The field that names the shared unknown."""
        return next((f for f in ("per_area", "per_mass") if getattr(self, f, None) is not None), "scale")

    def _scaled(self) -> tuple[str, float] | None:
        return None if self.scale is None or self.value is None else (self.scale, self.value)

    def _one_tie(self, shared: str, size: str) -> None:
        given = [name for name in (shared, size) if getattr(self, name) is not None]
        if len(given) == 1:
            raise ValueError(f"'{shared}' names a shared unknown and '{size}' what multiplies it; give both")
        own = [name for name in ("value", "guess", "bounds", "spread") if getattr(self, name) is not None]
        if given and own:
            raise ValueError(f"give either '{shared}' with '{size}', or '{own[0]}', not both")


class Conductance(Tied):
    """A conductance in W/K, alone or as an area times a shared coefficient in W/m2/K."""

    per_area: Name | None = None
    area_m2: Magnitude | None = None

    @model_validator(mode="after")
    def _area_with_name(self) -> Self:
        self._one_tie("per_area", "area_m2")
        return self

    @property
    def tie(self) -> tuple[str, float] | None:
        """The shared coefficient and the area, or the shared factor and the value."""
        return self._scaled() if self.per_area is None or self.area_m2 is None else (self.per_area, self.area_m2)

    @property
    def unit(self) -> str:
        """The unit of the shared unknown."""
        return "" if self.per_area is None else "W/m2/K"


class ExchangeArea(Tied):
    """The R of a radiative coupling in m2, alone or times a shared factor."""


class HeatCapacity(Tied):
    """A capacity in J/K, alone or as a mass times a shared specific capacity in J/kg/K; 0 for a node that stores nothing."""

    value: MagnitudeOrNone | None = None
    per_mass: Name | None = None
    mass_kg: Magnitude | None = None

    @model_validator(mode="after")
    def _mass_with_name(self) -> Self:
        self._one_tie("per_mass", "mass_kg")
        return self

    @property
    def tie(self) -> tuple[str, float] | None:
        """The shared specific capacity and the mass, or the shared factor and the value."""
        return self._scaled() if self.per_mass is None or self.mass_kg is None else (self.per_mass, self.mass_kg)

    @property
    def unit(self) -> str:
        """The unit of the shared unknown."""
        return "" if self.per_mass is None else "J/kg/K"


def guess_or(quantity: Quantity | None, default: float) -> float:
    """Return the value or guess of a quantity, or ``default`` where neither is declared."""
    if quantity is None:
        return default
    for number in (quantity.value, quantity.guess):
        if number is not None:
            return number
    if quantity.bounds is not None:
        return math.sqrt(quantity.bounds[0] * quantity.bounds[1])
    return default
