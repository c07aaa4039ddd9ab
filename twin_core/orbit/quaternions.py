"""Attitudes as quaternions: scalar first, Hamilton's product, v_frame = q v_body q*."""

import numpy as np

from twin_core._typing import FloatArray


def matrices(quaternions: FloatArray) -> FloatArray:
    """Return the matrices that turn as quaternions of any length but zero do, (..., 4) -> (..., 3, 3)."""
    unit = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(unit, -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def interpolated(time_s: FloatArray, sample_s: FloatArray, quaternions: FloatArray) -> FloatArray:
    """Return quaternions between samples: turning evenly by the shortest way, at rest before the first and after the last.

    Parameters
    ----------
    time_s : (n_times,)
    sample_s : (n_samples,)
        Increasing.
    quaternions : (n_samples, 4)
        Of any length but zero.

    Returns
    -------
    (n_times, 4)
        Spherical linear interpolation (Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985).
    """
    unit = quaternions / np.linalg.norm(quaternions, axis=1)[:, None]
    if sample_s.size == 1:
        return np.repeat(unit, time_s.size, axis=0)
    left = np.clip(np.searchsorted(sample_s, time_s, side="right") - 1, 0, sample_s.size - 2)
    share = np.clip((time_s - sample_s[left]) / (sample_s[left + 1] - sample_s[left]), 0.0, 1.0)
    cosine = np.einsum("ti,ti->t", unit[left], unit[left + 1])
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    turns = sine > 1e-9  # so close to rest the straight line is the arc
    first = np.where(turns, np.sin((1.0 - share) * angle) / np.where(turns, sine, 1.0), 1.0 - share)
    second = np.where(turns, np.sin(share * angle) / np.where(turns, sine, 1.0), share)
    other_way = np.where(cosine < 0.0, -second, second)  # q and -q are the same attitude
    return first[:, None] * unit[left] + other_way[:, None] * unit[left + 1]
