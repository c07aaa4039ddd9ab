"""How much of its surroundings the Earth fills for a plate at any tilt, one that spins and one that tumbles.

``distance`` is that of the Earth's centre over the Earth's radius, above 1, everywhere.
"""

import numpy as np

from twin_core._typing import FloatArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_UNIT_NODES, _UNIT_WEIGHTS = (_NODES + 1.0) / 2.0, _WEIGHTS / 2.0
N_AZIMUTHS = 12


def plate_view_factor(distance: FloatArray, cosine: FloatArray) -> FloatArray:
    """Return the view factor of a small flat plate to the sphere.

    Parameters
    ----------
    distance : (n_times,)
    cosine : (n_times,)
        Cosine of the angle between the plate's normal and the direction to the centre.

    Notes
    -----
    Closed form of Howell, Catalog of Radiation Heat Transfer Configuration Factors, B-43; a plate that sees the
    whole sphere has cos / H^2, one that is turned away has 0.
    """
    H, cosine = np.broadcast_arrays(np.maximum(distance, 1.0 + 1e-12), np.clip(cosine, -1.0, 1.0))
    root = np.sqrt(H**2 - 1.0)
    view = np.where(cosine * H >= 1.0, cosine / H**2, 0.0)
    partly = np.abs(cosine) * H < 1.0  # the plate's own plane cuts the sphere
    H, cosine, root = H[partly], cosine[partly], root[partly]
    sine = np.sqrt(1.0 - cosine**2)
    first = 0.5 - np.arcsin(np.clip(root / (H * sine), -1.0, 1.0)) / np.pi
    second = cosine * np.arccos(np.clip(-root * cosine / sine, -1.0, 1.0))
    third = root * np.sqrt(np.maximum(1.0 - (H * cosine) ** 2, 0.0))
    view[partly] = first + (second - third) / (np.pi * H**2)
    return view


def tumbling_view_factor(distance: FloatArray) -> FloatArray:
    """Return the mean view factor of a plate over all orientations, (1 - sqrt(1 - 1/H^2)) / 2, (n_times,).

    A quarter of the sphere's solid angle over pi: the mean of the positive part of a cosine over all orientations is 1/4.
    """
    H = np.maximum(distance, 1.0)
    return 0.5 / H**2 / (1.0 + np.sqrt(1.0 - 1.0 / H**2))  # without the cancellation far away


def spinning_view_factor(distance: FloatArray, cosine: FloatArray) -> FloatArray:
    """Return the mean view factor of a plate that spins about an axis in its own plane, (n_times,), to 2e-3 of itself.

    Over a turn the positive part of the cosine to a direction has the mean sin(angle to the axis) / pi; this is
    integrated over the sphere's disc.

    Parameters
    ----------
    distance : (n_times,)
    cosine : (n_times,)
        Cosine of the angle between the axis and the direction to the centre.
    """
    H, cosine = np.maximum(distance, 1.0), np.clip(cosine, -1.0, 1.0)
    sine = np.sqrt(1.0 - cosine**2)
    depth = 1.0 / H**2 / (1.0 + np.sqrt(1.0 - 1.0 / H**2))  # 1 - cos(angular radius)
    total = np.zeros(np.broadcast(H, cosine).shape)
    for node, weight in zip(_UNIT_NODES, _UNIT_WEIGHTS, strict=True):
        cos_off = 1.0 - depth * node
        sin_off = np.sqrt(1.0 - cos_off**2)
        for azimuth in (np.arange(N_AZIMUTHS) + 0.5) * np.pi / N_AZIMUTHS:
            along = cosine * cos_off + sine * sin_off * np.cos(azimuth)
            total += weight / N_AZIMUTHS * np.sqrt(np.maximum(1.0 - along**2, 0.0))
    return 2.0 * depth / np.pi * total


def mean_positive(level: FloatArray, swing: FloatArray) -> FloatArray:
    """Return the mean of max(0, level + swing cos(angle)) over a turn; ``swing`` is not negative."""
    most = np.maximum(swing, np.abs(level))
    lit = np.arccos(-level / np.where(most > 0.0, most, 1.0))  # half the angle over which the sum is positive
    return (level * lit + swing * np.sin(lit)) / np.pi


def illumination(distance: FloatArray, sun_height: FloatArray, *, by_cosine: bool) -> FloatArray:
    """Return the mean over the visible Earth of the cosine of the Sun's zenith angle, zero by night, (n_times,).

    Every point counts by the solid angle that it fills, or that times its cosine to the nadir (``by_cosine``). What an
    evenly reflecting Earth sends to a tumbling body, or to a plate that looks down, is exactly albedo times sunlight
    times the view factor times this; for a tilted plate it is the mean over all that is seen from here.

    Parameters
    ----------
    distance : (n_times,)
    sun_height : (n_times,)
        Cosine of the Sun's zenith angle at the point below.

    Notes
    -----
    Integrated in x, the cosine of the angle at the Earth's centre from the point below, 1/H <= x <= 1: with
    d^2 = H^2 + 1 - 2 H x the distance of the spacecraft, dx fills a solid angle of 2 pi (H x - 1) / d^3, seen at
    a cosine of (H - x) / d from the nadir. Over the azimuth it is a half-rectified cosine.
    """
    H, height = np.maximum(distance, 1.0 + 1e-12), np.clip(sun_height, -1.0, 1.0)
    depth = np.sqrt(1.0 - height**2)
    light, total = np.zeros(np.broadcast(H, height).shape), np.zeros(np.broadcast(H, height).shape)
    for node, weight in zip(_UNIT_NODES, _UNIT_WEIGHTS, strict=True):
        x = 1.0 / H + (1.0 - 1.0 / H) * node
        away2 = H**2 + 1.0 - 2.0 * H * x
        solid = weight * (H * x - 1.0) / away2**1.5
        if by_cosine:
            solid = solid * (H - x) / np.sqrt(away2)
        light += solid * mean_positive(x * height, np.sqrt(1.0 - x**2) * depth)
        total += solid
    return light / total
