"""What falls on a flat face in orbit: sun with eclipse and penumbra, albedo, planetary infrared."""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray
from twin_core.constants import ASTRONOMICAL_UNIT_M, EARTH_RADIUS_M, SOLAR_CONSTANT_W_PER_M2
from twin_core.errors import SpecError
from twin_core.fem.orbit import Orbit
from twin_core.units import sun_distance_au

SUN_RADIUS_M = 6.957e8
"""IAU 2015 resolution B3, nominal."""

EARTH_ALBEDO = 0.30
"""Bond albedo of the Earth, global mean (Gilmore, Spacecraft Thermal Control Handbook, 2nd edition, chapter 2)."""

EARTH_INFRARED_W_PER_M2 = 237.0
"""Emitted by the Earth, global mean (same chapter)."""

_J2000_NS = 946_728_000_000_000_000
_DAY_NS = 86_400_000_000_000


def sun_direction(epoch_ns: int, time_s: FloatArray) -> FloatArray:
    """Return the unit vector from the Earth to the Sun, (n_times, 3), equator of date, to about 0.01 degrees.

    Low-precision formula of the Astronomical Almanac, section C (valid 1950 to 2050).
    """
    days = (epoch_ns - _J2000_NS) / _DAY_NS + np.asarray(time_s, dtype=float) / 86_400.0
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly))
    tilt = np.radians(23.439 - 4e-7 * days)
    return np.stack([np.cos(longitude), np.cos(tilt) * np.sin(longitude), np.sin(tilt) * np.sin(longitude)], axis=-1)


def sunlit_fraction(position_m: FloatArray, sun: FloatArray, sun_distance_m: FloatArray) -> FloatArray:
    """Return the visible part of the Sun's disc, (n_times,): 0 in the umbra, 1 in full sun.

    Overlap of two discs as seen from the spacecraft (Montenbruck and Gill, Satellite Orbits, equations 3.85-3.87).

    Parameters
    ----------
    position_m : (n_times, 3)
    sun : (n_times, 3)
        Unit vector from the Earth.
    sun_distance_m : (n_times,)
    """
    to_sun = sun * sun_distance_m[:, None] - position_m
    away, radius = np.linalg.norm(to_sun, axis=-1), np.linalg.norm(position_m, axis=-1)
    a = np.arcsin(SUN_RADIUS_M / away)
    b = np.arcsin(np.minimum(EARTH_RADIUS_M / radius, 1.0))
    cosine = -np.einsum("ti,ti->t", position_m, to_sun) / (radius * away)
    c = np.arccos(np.clip(cosine, -1.0, 1.0))
    partly = (np.abs(a - b) < c) & (c < a + b)
    c_safe = np.where(partly, c, a + b)
    x = (c_safe**2 + a**2 - b**2) / (2.0 * c_safe)
    y = np.sqrt(np.maximum(a**2 - x**2, 0.0))
    arc_a = a**2 * np.arccos(np.clip(x / a, -1.0, 1.0))
    arc_b = b**2 * np.arccos(np.clip((c_safe - x) / b, -1.0, 1.0))
    covered = (arc_a + arc_b - c_safe * y) / (np.pi * a**2)
    return np.where(partly, 1.0 - covered, np.where(c <= np.abs(a - b), 0.0, 1.0))


def plate_to_sphere_view_factor(distance: FloatArray, cosine: FloatArray) -> FloatArray:
    """Return the view factor of a small flat plate to a sphere.

    Parameters
    ----------
    distance
        Centre distance over radius, above 1.
    cosine
        Cosine of the angle between the plate's normal and the direction to the centre.

    Notes
    -----
    Closed form of Howell, Catalog of Radiation Heat Transfer Configuration Factors, B-43; a plate that sees the
    whole sphere has cos / H^2, one that is turned away has 0.
    """
    H, gamma = np.maximum(distance, 1.0 + 1e-12), np.arccos(np.clip(cosine, -1.0, 1.0))
    horizon = np.arcsin(1.0 / H)
    root = np.sqrt(H**2 - 1.0)
    sine = np.maximum(np.sin(gamma), 1e-12)
    first = 0.5 - np.arcsin(np.clip(root / (H * sine), -1.0, 1.0)) / np.pi
    second = np.cos(gamma) * np.arccos(np.clip(-root * np.cos(gamma) / sine, -1.0, 1.0))
    third = root * np.sqrt(np.maximum(1.0 - (H * np.cos(gamma)) ** 2, 0.0))
    partial = first + (second - third) / (np.pi * H**2)
    whole = np.cos(gamma) / H**2
    return np.where(gamma <= np.pi / 2 - horizon, whole, np.where(gamma >= np.pi / 2 + horizon, 0.0, partial))


def face_normal(
    attitude: str,
    normal: tuple[float, float, float],
    position_m: FloatArray,
    velocity_m_per_s: FloatArray,
    sun: FloatArray,
) -> FloatArray:
    """Return a face's outward unit normal, (n_times, 3).

    Attitudes: ``inertial`` (the normal is given in the equatorial frame), ``nadir`` (x along the flight of a circular
    orbit, y against its angular momentum, z down), ``sun`` (z to the Sun, y along angular momentum x Sun).
    """
    body = np.array(normal) / np.linalg.norm(normal)
    if attitude not in ATTITUDES:
        raise SpecError(f"attitude: unknown attitude '{attitude}' (known: {', '.join(ATTITUDES)})")
    return ATTITUDES[attitude](position_m, velocity_m_per_s, sun) @ body


def _inertial(position_m: FloatArray, velocity_m_per_s: FloatArray, sun: FloatArray) -> FloatArray:
    return np.broadcast_to(np.eye(3), (*position_m.shape, 3))


def _nadir(position_m: FloatArray, velocity_m_per_s: FloatArray, sun: FloatArray) -> FloatArray:
    z = -_unit(position_m)
    y = -_unit(np.cross(position_m, velocity_m_per_s))
    return np.stack([np.cross(y, z), y, z], axis=-1)


def _to_sun(position_m: FloatArray, velocity_m_per_s: FloatArray, sun: FloatArray) -> FloatArray:
    # Where the Sun stands on the orbit's pole, the flight direction decides instead.
    momentum = _unit(np.cross(position_m, velocity_m_per_s))
    across = _unit(np.cross(momentum + 1e-9 * _unit(velocity_m_per_s), sun))
    return np.stack([np.cross(across, sun), across, sun], axis=-1)


def _unit(vector: FloatArray) -> FloatArray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


ATTITUDES = {"inertial": _inertial, "nadir": _nadir, "sun": _to_sun}
"""Attitude -> body axes as columns, (n_times, 3, 3)."""


@dataclass(frozen=True)
class FaceHeat:
    """Heat per area that falls on one face, W/m2, each (n_times,)."""

    solar: FloatArray
    albedo: FloatArray
    infrared: FloatArray


def face_heat(
    orbit: Orbit, attitude: str, normal: tuple[float, float, float], epoch_ns: int, time_s: FloatArray
) -> FaceHeat:
    """Return what falls on a flat face in orbit.

    Albedo takes the sunlit part of the Earth that the face sees as evenly bright, by the cosine of the Sun's angle
    at the point below the spacecraft (Gilmore, chapter 2); it is zero beyond the terminator.

    Raises
    ------
    SpecError
        If the attitude is unknown or the orbit runs into the Earth.
    """
    time_s = np.atleast_1d(np.asarray(time_s, dtype=float))
    position_m, velocity_m_per_s = orbit.state(epoch_ns, time_s)
    radius_m = np.linalg.norm(position_m, axis=-1)
    if (radius_m <= EARTH_RADIUS_M).any():
        raise SpecError(f"orbit: comes within {radius_m.min() / 1e3:.0f} km of the Earth's centre; raise it")
    sun, distance_au = sun_direction(epoch_ns, time_s), sun_distance_au(epoch_ns, time_s)
    outward = face_normal(attitude, normal, position_m, velocity_m_per_s, sun)
    sunlight = SOLAR_CONSTANT_W_PER_M2 / distance_au**2
    lit = sunlit_fraction(position_m, sun, distance_au * ASTRONOMICAL_UNIT_M)
    down = -position_m / radius_m[:, None]
    view = plate_to_sphere_view_factor(radius_m / EARTH_RADIUS_M, np.einsum("ti,ti->t", outward, down))
    height_of_sun = np.maximum(-np.einsum("ti,ti->t", down, sun), 0.0)
    return FaceHeat(
        solar=lit * sunlight * np.maximum(np.einsum("ti,ti->t", outward, sun), 0.0),
        albedo=EARTH_ALBEDO * sunlight * view * height_of_sun,
        infrared=EARTH_INFRARED_W_PER_M2 * view,
    )
