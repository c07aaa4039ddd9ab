"""The ``orbit`` block of a specification: elements, attitude, and what the Earth sends."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_serializer, model_validator

from twin_core.network.quantities import Name, Number, Strict
from twin_core.orbit.attitude import FACES, Attitude, Commanded, Held, Spinning, Tumbling
from twin_core.orbit.environment import EARTH_ALBEDO, EARTH_INFRARED_W_PER_M2, Environment, quantity_units
from twin_core.orbit.tle import TleOrbit, line_fault

PREFIX = "orbit."
"""Every channel of the orbit begins with it."""

Quaternion = tuple[Number, Number, Number, Number]


def _named(value: Any) -> Any:
    """Take ``nadir`` for ``{pointing: nadir}``."""
    return {"pointing": value} if isinstance(value, str) else value


def _line_1(value: str) -> str:
    return _checked(1, value.rstrip())


def _line_2(value: str) -> str:
    return _checked(2, value.rstrip())


def _checked(number: int, line: str) -> str:
    fault = line_fault(number, line)
    if fault is not None:
        raise ValueError(fault)
    return line


class AttitudeBlock(Strict):
    """How the spacecraft is turned: exactly one of the first four, the others where they belong.

    A quaternion (scalar first, Hamilton's product) turns body coordinates into those of the frame.
    """

    pointing: Literal["nadir", "sun", "tumbling"] | None = None
    inertial: Quaternion | None = None
    spin_axis: tuple[Number, Number, Number] | None = None
    quaternion_channels: tuple[Name, Name, Name, Name] | None = None
    frame: Literal["inertial", "orbit", "sun"] | None = None
    about: Literal["x", "y", "z"] | None = None

    @field_validator("inertial")
    @classmethod
    def _unit_length(cls, value: Quaternion | None) -> Quaternion | None:
        if value is not None and abs(sum(q * q for q in value) - 1.0) > 0.02:
            raise ValueError("is no attitude: the squares of the four numbers must add to 1")
        return value

    @field_validator("spin_axis")
    @classmethod
    def _points_somewhere(cls, value: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if value is not None and not any(value):
            raise ValueError("must not be (0, 0, 0)")
        return value

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        kinds = ("pointing", "inertial", "spin_axis", "quaternion_channels")
        given = [name for name in kinds if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                "give one of nadir, sun, tumbling, {inertial: [q0, q1, q2, q3]}, {spin_axis: [x, y, z]},"
                " {quaternion_channels: [q0, q1, q2, q3]}"
            )
        if self.frame is not None and given[0] not in ("spin_axis", "quaternion_channels"):
            raise ValueError("frame belongs to spin_axis or quaternion_channels")
        if self.about is not None and given[0] != "spin_axis":
            raise ValueError("about belongs to spin_axis")
        return self

    @model_serializer(mode="wrap")
    def _short(self, plain: Any) -> Any:
        return self.pointing or plain(self)

    @property
    def faces(self) -> tuple[str, ...]:
        """The faces that can be told apart."""
        return Tumbling().faces if self.pointing == "tumbling" else FACES

    def attitude(self, told: Commanded | None) -> Attitude:
        """Return the attitude; ``told`` is that of the channels, where there are any."""
        if told is not None:
            return told
        if self.spin_axis is not None:
            return Spinning(self.frame or "inertial", self.spin_axis, self.about or "z")
        if self.inertial is not None:
            return Held("inertial", self.inertial)
        return Tumbling() if self.pointing == "tumbling" else Held("orbit" if self.pointing == "nadir" else "sun")


class OrbitBlock(Strict):
    """An orbit around the Earth as an input of the twin."""

    tle: tuple[Annotated[str, AfterValidator(_line_1)], Annotated[str, AfterValidator(_line_2)]]
    attitude: Annotated[AttitudeBlock, BeforeValidator(_named)]
    albedo: Annotated[Number, Field(ge=0, le=1)] = EARTH_ALBEDO
    earth_infrared_W_per_m2: Annotated[Number, Field(ge=0, le=1000)] = EARTH_INFRARED_W_PER_M2

    @field_validator("tle")
    @classmethod
    def _of_one_satellite(cls, value: tuple[str, str]) -> tuple[str, str]:
        if value[0][2:7] != value[1][2:7]:
            raise ValueError(f"lines of two satellites, '{value[0][2:7]}' and '{value[1][2:7]}'; copy both of one")
        return value

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of every channel of the orbit, by its full name such as ``orbit.sun_px``."""
        return {PREFIX + name: unit for name, unit in quantity_units(self.attitude.faces).items()}

    @property
    def elements(self) -> TleOrbit:
        """The element set."""
        return TleOrbit(*self.tle)

    def environment(self, told: Commanded | None = None) -> Environment:
        """Return orbit, attitude and Earth; ``told`` is the attitude of the channels, where there are any."""
        return Environment(self.elements, self.attitude.attitude(told), self.albedo, self.earth_infrared_W_per_m2)
