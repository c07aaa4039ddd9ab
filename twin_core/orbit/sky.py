"""Sun and Earth as a spacecraft has them around it at many instants."""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.constants import ASTRONOMICAL_UNIT_M, EARTH_RADIUS_M, SOLAR_CONSTANT_W_PER_M2
from twin_core.errors import SpecError
from twin_core.orbit.path import Orbit
from twin_core.orbit.shadow import apparent_discs, visible_share
from twin_core.orbit.sun import sun_direction
from twin_core.units import sun_distance_au


@dataclass(frozen=True)
class Sky:
    """What surrounds a spacecraft, in the equatorial frame of date.

    Attributes
    ----------
    time_s : (n_times,)
        On the axis that the caller counts in.
    position_m, velocity_m_per_s : (n_times, 3)
    sun : (n_times, 3)
        Unit vector from the Earth.
    sun_distance_m : (n_times,)
        From the Earth.
    """

    time_s: FloatArray
    position_m: FloatArray
    velocity_m_per_s: FloatArray
    sun: FloatArray
    sun_distance_m: FloatArray

    def take(self, index: IntArray) -> "Sky":
        """Return the sky at some of the instants."""
        return Sky(*(getattr(self, item.name)[index] for item in fields(self)))

    @cached_property
    def discs(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Angular radii of Sun and Earth and the angle between their centres, (n_times,) in rad."""
        return apparent_discs(self.position_m, self.sun, self.sun_distance_m)

    @cached_property
    def distance(self) -> FloatArray:
        """Distance of the Earth's centre in Earth radii, (n_times,)."""
        return np.sqrt(np.einsum("ti,ti->t", self.position_m, self.position_m)) / EARTH_RADIUS_M

    @cached_property
    def down(self) -> FloatArray:
        """Unit vector to the Earth's centre, (n_times, 3)."""
        return -self.position_m / (EARTH_RADIUS_M * self.distance[:, None])

    @cached_property
    def pole(self) -> FloatArray:
        """Unit vector along the orbit's angular momentum, (n_times, 3)."""
        return unit(np.cross(self.position_m, self.velocity_m_per_s))

    @cached_property
    def sun_height(self) -> FloatArray:
        """Cosine of the Sun's zenith angle at the point below, (n_times,)."""
        return -np.einsum("ti,ti->t", self.down, self.sun)

    @cached_property
    def sunlight_W_per_m2(self) -> FloatArray:
        """Sunlight on a plate that faces the Sun, outside the shadow, (n_times,)."""
        return SOLAR_CONSTANT_W_PER_M2 * (ASTRONOMICAL_UNIT_M / self.sun_distance_m) ** 2

    @cached_property
    def sunlit(self) -> FloatArray:
        """Visible part of the Sun's disc, (n_times,)."""
        return visible_share(*self.discs)

    @cached_property
    def beta_deg(self) -> FloatArray:
        """Angle of the Sun above the plane of the orbit, positive on the side of the angular momentum, (n_times,)."""
        return np.degrees(np.arcsin(np.clip(np.einsum("ti,ti->t", self.pole, self.sun), -1.0, 1.0)))


def sky_at(orbit: Orbit, epoch_ns: int, time_s: FloatArray) -> Sky:
    """Return the sky at instants.

    Parameters
    ----------
    orbit
        Where the spacecraft is.
    epoch_ns
        Unix nanoseconds of ``time_s = 0``.
    time_s : (n_times,)

    Raises
    ------
    SpecError
        If the orbit runs into the Earth or cannot be followed to these instants.
    """
    position_m, velocity_m_per_s = orbit.state(epoch_ns, time_s)
    distance_m = sun_distance_au(epoch_ns, time_s) * ASTRONOMICAL_UNIT_M
    sky = Sky(time_s, position_m, velocity_m_per_s, sun_direction(epoch_ns, time_s), distance_m)
    if (sky.distance <= 1.0).any():
        lowest_km = sky.distance.min() * EARTH_RADIUS_M / 1e3
        raise SpecError(f"orbit: comes within {lowest_km:.0f} km of the Earth's centre; raise it")
    return sky


def unit(vectors: FloatArray) -> FloatArray:
    """Return vectors, (n_times, 3), at length one."""
    return vectors / np.sqrt(np.einsum("ti,ti->t", vectors, vectors))[:, None]
