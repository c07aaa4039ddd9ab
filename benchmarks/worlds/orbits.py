"""Orbits of many shapes, and the heat that they bring to the faces of a spacecraft."""

from dataclasses import dataclass

import numpy as np

MU_M3_PER_S2 = 3.986004418e14
EARTH_M = 6.371e6
SUN_W_PER_M2 = 1361.0
INFRARED_W_PER_M2 = 237.0
"""Emitted by the Earth on average (Gilmore, Spacecraft Thermal Control Handbook, 2nd edition, chapter 2)."""

KINDS = ("low", "dawn_dusk", "eccentric", "molniya", "geostationary", "spinning", "slewing")


@dataclass(frozen=True)
class Orbit:
    """An orbit and an attitude.

    Attributes
    ----------
    kind
        One of ``KINDS``.
    perigee_m, eccentricity
        Radius of the perigee.
    beta_rad
        Angle between the Sun and the plane of the orbit.
    node_rad
        Argument of the perigee, from where the orbit comes closest to the Sun.
    attitude
        "nadir", "inertial" or "spin".
    spin_s
        Period of the spin about the axis along z.
    heading_rad
        How it is turned about z to begin with.
    slews
        (instant in s, angle in rad): turns about z, at a tenth of a degree per second.
    albedo
        Share of the sunlight that the Earth reflects.
    """

    kind: str
    perigee_m: float
    eccentricity: float
    beta_rad: float
    node_rad: float
    attitude: str
    spin_s: float
    heading_rad: float
    slews: tuple[tuple[float, float], ...]
    albedo: float

    @property
    def period_s(self) -> float:
        """One revolution."""
        axis = self.perigee_m / (1.0 - self.eccentricity)
        return float(2.0 * np.pi * np.sqrt(axis**3 / MU_M3_PER_S2))

    def position(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distance, (n,) in m, and true anomaly plus argument of perigee, (n,), by Kepler's equation."""
        mean = 2.0 * np.pi * time_s / self.period_s
        e, eccentric = self.eccentricity, mean.copy()
        for _ in range(30):
            eccentric = eccentric - (eccentric - e * np.sin(eccentric) - mean) / (1.0 - e * np.cos(eccentric))
        distance = self.perigee_m / (1.0 - e) * (1.0 - e * np.cos(eccentric))
        anomaly = 2.0 * np.arctan2(np.sqrt(1 + e) * np.sin(eccentric / 2), np.sqrt(1 - e) * np.cos(eccentric / 2))
        return distance, anomaly + self.node_rad

    def turn_rad(self, time_s: np.ndarray) -> np.ndarray:
        """Return how far the spacecraft is turned about its z axis, (n,)."""
        turn = np.full(time_s.size, self.heading_rad)
        if self.attitude == "spin":
            turn += 2.0 * np.pi * time_s / self.spin_s
        rate = np.deg2rad(0.1)
        for instant, angle in self.slews:
            turn += np.sign(angle) * np.clip(rate * (time_s - instant), 0.0, abs(angle))
        return turn

    def flux_W_per_m2(self, normal: np.ndarray, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return sunlight (direct and reflected) and the Earth's infrared on a face, (n,) each.

        ``normal`` is the face's outward direction in the body's frame: x towards the Earth when nadir pointing.
        """
        distance, angle = self.position(time_s)
        up = np.stack([np.cos(angle), np.sin(angle), np.zeros(angle.size)])
        sun = np.array([np.cos(self.beta_rad), 0.0, np.sin(self.beta_rad)])
        if self.attitude == "nadir":
            x, y = -up, np.stack([np.sin(angle), -np.cos(angle), np.zeros(angle.size)])
        else:
            x = np.repeat(np.array([[1.0], [0.0], [0.0]]), angle.size, axis=1)
            y = np.repeat(np.array([[0.0], [1.0], [0.0]]), angle.size, axis=1)
        z = np.cross(x, y, axis=0)
        turn = self.turn_rad(time_s)
        x, y = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
        face = normal[0] * x + normal[1] * y + normal[2] * z
        lit = self.lit(time_s)
        disc = (EARTH_M / distance) ** 2
        # View factor of a small plate to a distant sphere, smooth through the horizon.
        towards = disc * np.clip(0.15 - np.sum(face * up, axis=0), 0.0, None) / 1.15
        day = np.clip(np.sum(up * sun[:, None], axis=0), 0.0, None)
        direct = SUN_W_PER_M2 * lit * np.clip(np.sum(face * sun[:, None], axis=0), 0.0, None)
        return direct + SUN_W_PER_M2 * self.albedo * day * towards, INFRARED_W_PER_M2 * towards

    def lit(self, time_s: np.ndarray) -> np.ndarray:
        """Return how much of the Sun is seen, (n,): 0 in the Earth's shadow, with a penumbra of its usual width."""
        distance, angle = self.position(time_s)
        up = np.stack([np.cos(angle), np.sin(angle), np.zeros(angle.size)]) * distance
        sun = np.array([np.cos(self.beta_rad), 0.0, np.sin(self.beta_rad)])
        along = sun @ up
        aside = np.sqrt(np.maximum(distance**2 - along**2, 0.0))
        width = 0.0047 * np.abs(along) + 1.0
        shadow = np.clip((EARTH_M + width - aside) / (2.0 * width), 0.0, 1.0)
        return np.where(along < 0.0, 1.0 - shadow, 1.0)


def draw_orbit(rng: np.random.Generator) -> Orbit:
    """Return an orbit of one of ``KINDS``."""
    kind = str(rng.choice(KINDS))
    radius, eccentricity, beta = EARTH_M + float(rng.uniform(4.5e5, 9e5)), 0.0, float(rng.uniform(-0.6, 0.6))
    attitude = str(rng.choice(["nadir", "inertial"]))
    if kind == "dawn_dusk":
        beta = float(rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 1.12))  # the shadow is barely touched
    if kind == "eccentric":
        eccentricity = float(rng.uniform(0.15, 0.4))
    if kind == "molniya":
        eccentricity, attitude = float(rng.uniform(0.6, 0.74)), "inertial"
        radius = (MU_M3_PER_S2 * (43_082.0 / (2.0 * np.pi)) ** 2) ** (1.0 / 3.0) * (1.0 - eccentricity)
        radius = max(radius, EARTH_M + 5e5)
    if kind == "geostationary":
        radius, beta, attitude = 4.2164e7, float(rng.uniform(-0.13, 0.13)), "nadir"
    slews: list[tuple[float, float]] = []
    if kind == "slewing" or (attitude == "inertial" and rng.random() < 0.5):
        instants = np.cumsum(rng.uniform(4e3, 2.2e4, 12)) * (4.0 if kind == "molniya" else 1.0)
        slews = [(float(t), float(rng.choice([-1, 1]) * rng.uniform(0.5, 2.2))) for t in instants]
    if kind == "spinning":
        attitude = "spin"
    return Orbit(
        kind,
        radius,
        eccentricity,
        beta,
        float(rng.uniform(0.0, 2.0 * np.pi)),
        attitude,
        float(rng.uniform(400.0, 1800.0)),
        0.0 if attitude == "nadir" else float(rng.uniform(0.0, 2.0 * np.pi)),
        tuple(slews),
        float(rng.uniform(0.2, 0.4)),
    )
