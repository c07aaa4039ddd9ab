"""How a spacecraft is turned, and how much of Sun and Earth each of its faces has for that.

Faces are named after the axis of the body that leaves them: ``px`` is the face whose outward normal is +x.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from twin_core._typing import FloatArray
from twin_core.orbit.quaternions import interpolated, matrices
from twin_core.orbit.sky import Sky, unit
from twin_core.orbit.view_factors import (
    illumination,
    mean_positive,
    plate_view_factor,
    spinning_view_factor,
    tumbling_view_factor,
)

FACES = ("px", "mx", "py", "my", "pz", "mz")
MEAN = "mean"
"""The one face of a body that tumbles: the average over all orientations."""


class Exposure(NamedTuple):
    """What one face has of its surroundings, each (n_times,).

    ``sun``: sunlight on it over sunlight on a plate that faces the Sun, eclipse aside. ``earth``: its view factor to the
    Earth. ``lit``: that times the mean cosine of the Sun's zenith angle over the Earth that is seen from here.
    """

    sun: FloatArray
    earth: FloatArray
    lit: FloatArray


class Attitude(Protocol):
    """How a spacecraft is turned."""

    @property
    def faces(self) -> tuple[str, ...]:
        """The faces that can be told apart."""
        ...

    def exposures(self, sky: Sky) -> Mapping[str, Exposure]:
        """Return what each face has."""
        ...


def plate(sky: Sky, outward: FloatArray) -> Exposure:
    """Return what a flat face with an outward unit normal, (n_times, 3), has."""
    view = plate_view_factor(sky.distance, np.einsum("ti,ti->t", outward, sky.down))
    lit = illumination(sky.distance, sky.sun_height, by_cosine=True)
    return Exposure(np.maximum(np.einsum("ti,ti->t", outward, sky.sun), 0.0), view, view * lit)


def _inertial(sky: Sky) -> FloatArray:
    return np.broadcast_to(np.eye(3), (sky.time_s.size, 3, 3))


def _orbital(sky: Sky) -> FloatArray:
    z, y = sky.down, -sky.pole
    return np.stack([np.cross(y, z), y, z], axis=-1)


def _solar(sky: Sky) -> FloatArray:
    # Where the Sun stands on the orbit's pole, the flight direction decides instead.
    across = unit(np.cross(sky.pole + 1e-9 * unit(sky.velocity_m_per_s), sky.sun))
    return np.stack([np.cross(across, sky.sun), across, sky.sun], axis=-1)


FRAMES: Mapping[str, Callable[[Sky], FloatArray]] = {"inertial": _inertial, "orbit": _orbital, "sun": _solar}
"""Frame -> its axes as columns in the equatorial frame of date, (n_times, 3, 3).

``inertial``: that frame itself. ``orbit``: z down, y against the orbit's angular momentum, x along the flight of a
circular orbit. ``sun``: z to the Sun, y along angular momentum x Sun.
"""


@dataclass(frozen=True)
class Held:
    """A body that keeps its place in a frame; ``quaternion`` (scalar first) turns body coordinates into that frame's."""

    frame: str
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @property
    def faces(self) -> tuple[str, ...]:
        """All six."""
        return FACES

    def axes(self, sky: Sky) -> FloatArray:
        """Return the axes of the body as columns, (n_times, 3, 3)."""
        return FRAMES[self.frame](sky) @ matrices(np.array(self.quaternion))

    def exposures(self, sky: Sky) -> Mapping[str, Exposure]:
        """Return what each face has."""
        return _of_axes(sky, self.axes(sky))


@dataclass(frozen=True)
class Commanded:
    """A body whose attitude is told sample by sample; between samples it turns evenly by the shortest way.

    Attributes
    ----------
    frame
        The frame into which the quaternions turn body coordinates.
    time_s : (n_samples,)
        On the axis of the sky; before the first and after the last sample the attitude holds.
    quaternion : (n_samples, 4)
        Scalar first, of any length but zero.
    """

    frame: str
    time_s: FloatArray
    quaternion: FloatArray

    @property
    def faces(self) -> tuple[str, ...]:
        """All six."""
        return FACES

    def exposures(self, sky: Sky) -> Mapping[str, Exposure]:
        """Return what each face has."""
        turns = matrices(interpolated(sky.time_s, self.time_s, self.quaternion))
        return _of_axes(sky, FRAMES[self.frame](sky) @ turns)


@dataclass(frozen=True)
class Spinning:
    """A body that spins about one of its axes, which keeps its place in a frame; the other faces are averaged over a turn.

    Attributes
    ----------
    frame
        The frame in which the axis rests.
    direction
        Where the positive axis points in it, of any length but zero.
    about
        The axis of the body: ``x``, ``y`` or ``z``.
    """

    frame: str
    direction: tuple[float, float, float]
    about: str = "z"

    @property
    def faces(self) -> tuple[str, ...]:
        """All six; the four around the axis have the same."""
        return FACES

    def exposures(self, sky: Sky) -> Mapping[str, Exposure]:
        """Return what each face has."""
        axis = FRAMES[self.frame](sky) @ (np.array(self.direction) / np.linalg.norm(self.direction))
        level = np.einsum("ti,ti->t", axis, sky.sun)
        around = mean_positive(np.zeros_like(level), np.sqrt(np.maximum(1.0 - level**2, 0.0)))
        view = spinning_view_factor(sky.distance, np.einsum("ti,ti->t", axis, sky.down))
        lit = illumination(sky.distance, sky.sun_height, by_cosine=True)
        side = Exposure(around, view, view * lit)
        ends = {f"p{self.about}": plate(sky, axis), f"m{self.about}": plate(sky, -axis)}
        return {face: ends.get(face, side) for face in FACES}


@dataclass(frozen=True)
class Tumbling:
    """A body that turns every way: each of its faces has the average over all orientations."""

    @property
    def faces(self) -> tuple[str, ...]:
        """The average alone."""
        return (MEAN,)

    def exposures(self, sky: Sky) -> Mapping[str, Exposure]:
        """Return what a face has on average; a quarter of the sunlight."""
        view = tumbling_view_factor(sky.distance)
        lit = illumination(sky.distance, sky.sun_height, by_cosine=False)
        return {MEAN: Exposure(np.full(view.shape, 0.25), view, view * lit)}


def _of_axes(sky: Sky, axes: FloatArray) -> dict[str, Exposure]:
    """Return what the six faces of a body with these axes, (n_times, 3, 3), have."""
    lit = illumination(sky.distance, sky.sun_height, by_cosine=True)
    exposures: dict[str, Exposure] = {}
    for k, axis in enumerate("xyz"):
        to_sun = np.einsum("ti,ti->t", axes[:, :, k], sky.sun)
        to_earth = np.einsum("ti,ti->t", axes[:, :, k], sky.down)
        for face, sign in (("p", 1.0), ("m", -1.0)):
            view = plate_view_factor(sky.distance, sign * to_earth)
            exposures[face + axis] = Exposure(np.maximum(sign * to_sun, 0.0), view, view * lit)
    return exposures
