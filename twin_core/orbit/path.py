"""Where a spacecraft is: any orbit, and Keplerian elements with the drift by the Earth's oblateness."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from twin_core._typing import FloatArray
from twin_core.constants import EARTH_GM_M3_PER_S2, EARTH_RADIUS_M

EARTH_J2 = 1.08262668e-3
"""Second zonal harmonic (EGM96)."""


class Orbit(Protocol):
    """Where a spacecraft is."""

    def state(self, epoch_ns: int, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position (m) and velocity (m/s), each (n_times, 3), in the equatorial frame of date."""


@dataclass(frozen=True)
class KeplerOrbit:
    """Keplerian elements at an instant, with the secular drift of node and perigee by the Earth's oblateness."""

    semi_major_axis_m: float
    eccentricity: float
    inclination_deg: float
    node_deg: float
    perigee_deg: float
    mean_anomaly_deg: float
    epoch_ns: int

    @property
    def period_s(self) -> float:
        """Period of revolution."""
        return float(2.0 * np.pi * np.sqrt(self.semi_major_axis_m**3 / EARTH_GM_M3_PER_S2))

    def state(self, epoch_ns: int, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position (m) and velocity (m/s), each (n_times, 3)."""
        elapsed_s = (epoch_ns - self.epoch_ns) / 1e9 + np.asarray(time_s, dtype=float)
        mean_motion = 2.0 * np.pi / self.period_s
        anomaly = solve_kepler(np.radians(self.mean_anomaly_deg) + mean_motion * elapsed_s, self.eccentricity)
        e, a, root = self.eccentricity, self.semi_major_axis_m, np.sqrt(1.0 - self.eccentricity**2)
        plane = a * np.stack([np.cos(anomaly) - e, root * np.sin(anomaly)], axis=-1)
        rate = mean_motion / (1.0 - e * np.cos(anomaly))
        speed = a * rate[:, None] * np.stack([-np.sin(anomaly), root * np.cos(anomaly)], axis=-1)
        axes = self._axes(elapsed_s, mean_motion)
        return np.einsum("tik,tk->ti", axes, plane), np.einsum("tik,tk->ti", axes, speed)

    def _axes(self, elapsed_s: FloatArray, mean_motion: float) -> FloatArray:
        """Return the unit vectors to and across perigee, (n_times, 3, 2), with secular J2 drift.

        Rates: Vallado, Fundamentals of Astrodynamics and Applications, 4th edition, equations 9-37 and 9-39.
        """
        parameter = self.semi_major_axis_m * (1.0 - self.eccentricity**2)
        strength = 1.5 * EARTH_J2 * (EARTH_RADIUS_M / parameter) ** 2 * mean_motion
        tilt = np.radians(self.inclination_deg)
        node = np.radians(self.node_deg) - strength * np.cos(tilt) * elapsed_s
        perigee = np.radians(self.perigee_deg) + strength * (2.0 - 2.5 * np.sin(tilt) ** 2) * elapsed_s
        to_node = np.stack([np.cos(node), np.sin(node), np.zeros_like(node)], axis=-1)
        across = np.stack(
            [-np.sin(node) * np.cos(tilt), np.cos(node) * np.cos(tilt), np.full_like(node, np.sin(tilt))], axis=-1
        )
        cos, sin = np.cos(perigee)[:, None], np.sin(perigee)[:, None]
        return np.stack([cos * to_node + sin * across, -sin * to_node + cos * across], axis=-1)


def solve_kepler(mean_anomaly: FloatArray, eccentricity: float) -> FloatArray:
    """Return the eccentric anomaly E with E - e sin E = M (radians), by Newton's iteration."""
    anomaly = mean_anomaly + eccentricity * np.sin(mean_anomaly)
    for _ in range(50):
        step = (anomaly - eccentricity * np.sin(anomaly) - mean_anomaly) / (1.0 - eccentricity * np.cos(anomaly))
        anomaly = anomaly - step
        if np.max(np.abs(step), initial=0.0) < 1e-13:
            break
    return anomaly
