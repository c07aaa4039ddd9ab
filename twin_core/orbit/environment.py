"""What falls on the faces of a spacecraft in orbit: sunlight with eclipse and penumbra, albedo, infrared of the Earth."""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray
from twin_core.orbit.attitude import Attitude, Held, plate
from twin_core.orbit.path import Orbit
from twin_core.orbit.sky import Sky, sky_at

EARTH_ALBEDO = 0.30
"""Bond albedo of the Earth, global mean (Gilmore, Spacecraft Thermal Control Handbook, 2nd edition, chapter 2)."""

EARTH_INFRARED_W_PER_M2 = 237.0
"""Emitted by the Earth, global mean (same chapter)."""

ECLIPSE, BETA = "eclipse", "beta"


@dataclass(frozen=True)
class Environment:
    """Orbit, attitude and Earth together.

    Attributes
    ----------
    orbit, attitude
        Where the spacecraft is and how it is turned.
    albedo
        Share of the sunlight that the Earth reflects, evenly to all sides (Lambert).
    infrared_W_per_m2
        What the Earth emits.
    """

    orbit: Orbit
    attitude: Attitude
    albedo: float = EARTH_ALBEDO
    infrared_W_per_m2: float = EARTH_INFRARED_W_PER_M2

    def sky(self, epoch_ns: int, time_s: FloatArray) -> Sky:
        """Return the sky at instants; SpecError if the orbit cannot be followed to them."""
        return sky_at(self.orbit, epoch_ns, time_s)

    def quantities(self, sky: Sky) -> dict[str, FloatArray]:
        """Return every quantity of the orbit, each (n_times,).

        ``sun_<face>``, ``albedo_<face>``, ``earth_<face>`` in W/m2, ``eclipse`` (0 sunlit to 1 umbra), ``beta`` in deg.
        """
        found: dict[str, FloatArray] = {}
        direct, reflected = sky.sunlit * sky.sunlight_W_per_m2, self.albedo * sky.sunlight_W_per_m2
        for face, exposure in self.attitude.exposures(sky).items():
            found[f"sun_{face}"] = direct * exposure.sun
            found[f"albedo_{face}"] = reflected * exposure.lit
            found[f"earth_{face}"] = self.infrared_W_per_m2 * exposure.earth
        found[ECLIPSE] = 1.0 - sky.sunlit
        found[BETA] = sky.beta_deg
        return found


def quantity_units(faces: tuple[str, ...]) -> dict[str, str]:
    """Return the unit of every quantity of an orbit, by name, given the faces of the attitude."""
    units = {f"{kind}_{face}": "W/m2" for face in faces for kind in ("sun", "albedo", "earth")}
    return units | {ECLIPSE: "", BETA: "deg"}


@dataclass(frozen=True)
class FaceHeat:
    """Heat per area that falls on one face, W/m2, each (n_times,)."""

    solar: FloatArray
    albedo: FloatArray
    infrared: FloatArray


def face_heat(
    orbit: Orbit, frame: str, normal: tuple[float, float, float], epoch_ns: int, time_s: FloatArray
) -> FaceHeat:
    """Return what falls on one flat face of a body that rests in a frame of ``attitude.FRAMES``, at instants.

    Raises
    ------
    SpecError
        If the orbit runs into the Earth or cannot be followed to these instants.
    """
    sky = sky_at(orbit, epoch_ns, np.atleast_1d(np.asarray(time_s, dtype=float)))
    exposure = plate(sky, Held(frame).axes(sky) @ (np.array(normal) / np.linalg.norm(normal)))
    sunlight = sky.sunlight_W_per_m2
    return FaceHeat(
        solar=sky.sunlit * sunlight * exposure.sun,
        albedo=EARTH_ALBEDO * sunlight * exposure.lit,
        infrared=EARTH_INFRARED_W_PER_M2 * exposure.earth,
    )
