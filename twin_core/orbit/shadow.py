"""The Earth's shadow: how much of the Sun's disc a spacecraft sees."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.constants import EARTH_RADIUS_M

SUN_RADIUS_M = 6.957e8
"""IAU 2015 resolution B3, nominal."""


def apparent_discs(
    position_m: FloatArray, sun: FloatArray, sun_distance_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the angular radii of the Sun's and the Earth's disc and the angle between their centres, (n_times,) in rad.

    The Earth is a sphere of its equatorial radius without air. Towards the poles its surface lies up to 21 km lower; light
    that passes lower than about 20 km is mostly scattered away. In a low orbit, where the ray to the Sun sinks by 3 km
    a second, each of the two shifts the edge of an eclipse by up to 7 s, against each other.

    Parameters
    ----------
    position_m : (n_times, 3)
    sun : (n_times, 3)
        Unit vector from the Earth.
    sun_distance_m : (n_times,)
        From the Earth.
    """
    to_sun = sun * sun_distance_m[:, None] - position_m
    away, radius = _length(to_sun), _length(position_m)
    cosine = -np.einsum("ti,ti->t", position_m, to_sun) / (radius * away)
    return (
        np.arcsin(SUN_RADIUS_M / away),
        np.arcsin(np.minimum(EARTH_RADIUS_M / radius, 1.0)),
        np.arccos(np.clip(cosine, -1.0, 1.0)),
    )


def visible_share(sun_radius: FloatArray, earth_radius: FloatArray, apart: FloatArray) -> FloatArray:
    """Return the visible part of the Sun's disc, (n_times,): 0 in the umbra, 1 in full sun.

    Overlap of two discs (Montenbruck and Gill, Satellite Orbits, equations 3.85-3.87); arguments as
    :func:`apparent_discs` returns them.
    """
    a, b, c = sun_radius, earth_radius, apart
    # Far beyond the Earth its disc is the smaller one and leaves a ring.
    share = np.where(c <= np.abs(a - b), np.where(b >= a, 0.0, 1.0 - (b / a) ** 2), 1.0)
    partly = (np.abs(a - b) < c) & (c < a + b)
    a, b, c = a[partly], b[partly], c[partly]
    x = (c**2 + a**2 - b**2) / (2.0 * c)
    y = np.sqrt(np.maximum(a**2 - x**2, 0.0))
    arc_a = a**2 * np.arccos(np.clip(x / a, -1.0, 1.0))
    arc_b = b**2 * np.arccos(np.clip((c - x) / b, -1.0, 1.0))
    share[partly] = np.clip(1.0 - (arc_a + arc_b - c * y) / (np.pi * a**2), 0.0, 1.0)
    return share


def _length(vectors: FloatArray) -> FloatArray:
    return np.sqrt(np.einsum("ti,ti->t", vectors, vectors))
