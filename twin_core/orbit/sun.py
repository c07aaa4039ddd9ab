"""Where the Sun stands as seen from the Earth."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.units import J2000_NS


def sun_direction(epoch_ns: int, time_s: FloatArray) -> FloatArray:
    """Return the unit vector from the Earth to the Sun, (n_times, 3), equator of date, to about 0.01 degrees.

    Low-precision formula of the Astronomical Almanac, section C (valid 1950 to 2050).
    """
    days = (epoch_ns - J2000_NS) / 86_400e9 + np.asarray(time_s, dtype=float) / 86_400.0
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly))
    tilt = np.radians(23.439 - 4e-7 * days)
    return np.stack([np.cos(longitude), np.cos(tilt) * np.sin(longitude), np.sin(tilt) * np.sin(longitude)], axis=-1)
