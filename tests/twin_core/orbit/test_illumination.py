"""Heat on faces in orbit against numerical integration and simple geometry."""

import numpy as np
import pytest

from twin_core.constants import ASTRONOMICAL_UNIT_M, EARTH_RADIUS_M
from twin_core.errors import SpecError
from twin_core.fem.illumination import (
    EARTH_INFRARED_W_PER_M2,
    SUN_RADIUS_M,
    face_heat,
    face_normal,
    plate_to_sphere_view_factor,
    sun_direction,
    sunlit_fraction,
)
from twin_core.fem.orbit import KeplerOrbit
from twin_core.units import parse_instant_ns

EQUINOX_NS = parse_instant_ns("2026-03-20T14:46:00Z")
SOLSTICE_NS = parse_instant_ns("2026-06-21T08:25:00Z")
LOW = KeplerOrbit(EARTH_RADIUS_M + 500e3, 0.0, 0.0, 0.0, 0.0, 0.0, EQUINOX_NS)


def integrated_view_factor(distance: float, angle: float) -> float:
    """Return the view factor by summing cosine over the directions that meet the sphere."""
    horizon = np.arcsin(1.0 / distance)
    edges_t, edges_p = np.linspace(0.0, horizon, 801), np.linspace(0.0, 2.0 * np.pi, 801)
    t, p = ((e[:-1] + e[1:]) / 2.0 for e in (edges_t, edges_p))
    polar, azimuth = np.meshgrid(t, p, indexing="ij")
    cosine = np.cos(angle) * np.cos(polar) + np.sin(angle) * np.sin(polar) * np.cos(azimuth)
    solid = np.sin(polar) * (edges_t[1] - edges_t[0]) * (edges_p[1] - edges_p[0])
    return float(np.sum(np.maximum(cosine, 0.0) * solid) / np.pi)


@pytest.mark.parametrize("distance", [1.05, 1.2, 3.0])
@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 75.0, 90.0, 110.0, 150.0, 180.0])
def test_view_factor_to_the_planet_equals_the_integral(distance: float, angle_deg: float) -> None:
    """Closed form against the sum over directions, whole, partial and no view."""
    closed = plate_to_sphere_view_factor(np.array([distance]), np.array([np.cos(np.radians(angle_deg))]))[0]
    assert closed == pytest.approx(integrated_view_factor(distance, np.radians(angle_deg)), abs=2e-5)


def test_sun_stands_on_the_equator_at_equinox_and_on_the_tropic_at_solstice() -> None:
    """Declination 0 at the equinox of 2026 and 23.44 degrees at the solstice, to 0.02 degrees."""
    for epoch_ns, declination_deg in ((EQUINOX_NS, 0.0), (SOLSTICE_NS, 23.44)):
        z = sun_direction(epoch_ns, np.zeros(1))[0, 2]
        assert np.degrees(np.arcsin(z)) == pytest.approx(declination_deg, abs=0.02)


def test_shadow_has_umbra_penumbra_and_light() -> None:
    """Behind the Earth: dark on the axis, half of the disc where its centre touches the limb, light beyond."""
    sun, away_m = np.array([[1.0, 0.0, 0.0]]), np.array([ASTRONOMICAL_UNIT_M])
    behind_m = 7_000e3
    limb = np.arcsin(EARTH_RADIUS_M / behind_m)
    half_disc = SUN_RADIUS_M / ASTRONOMICAL_UNIT_M

    def lit(angle: float) -> float:
        place = behind_m * np.array([[-np.cos(angle), np.sin(angle), 0.0]])
        return float(sunlit_fraction(place, sun, away_m)[0])

    assert lit(0.0) == lit(limb - 1.1 * half_disc) == 0.0
    assert lit(limb + 1.1 * half_disc) == lit(np.pi) == 1.0
    assert lit(limb) == pytest.approx(0.5, abs=0.01)
    inside = [lit(limb + x * half_disc) for x in np.linspace(-0.99, 0.99, 21)]
    assert (np.diff(inside) > 0.0).all()


def test_eclipse_lasts_as_the_cylinder_says() -> None:
    """Equatorial orbit at equinox: the dark part of the orbit is 2 asin(R / r), to the width of the penumbra."""
    time_s = np.arange(0.0, LOW.period_s, 1.0)
    heat = face_heat(LOW, "sun", (0.0, 0.0, 1.0), EQUINOX_NS, time_s)
    dark = np.mean(heat.solar < 0.5 * heat.solar.max())
    assert dark == pytest.approx(2.0 * np.arcsin(EARTH_RADIUS_M / LOW.semi_major_axis_m) / (2.0 * np.pi), abs=2e-3)


def test_faces_of_a_nadir_pointing_cube() -> None:
    """The down face sees infrared R^2/r^2; the up face none; opposite faces never see the Sun together."""
    time_s = np.linspace(0.0, LOW.period_s, 200)
    down, up = (face_heat(LOW, "nadir", (0.0, 0.0, z), EQUINOX_NS, time_s) for z in (1.0, -1.0))
    ratio = (EARTH_RADIUS_M / LOW.semi_major_axis_m) ** 2
    np.testing.assert_allclose(down.infrared, EARTH_INFRARED_W_PER_M2 * ratio, rtol=1e-9)
    assert (up.infrared == 0.0).all() and (up.albedo == 0.0).all()
    assert ((down.solar == 0.0) | (up.solar == 0.0)).all()
    assert down.albedo.max() == pytest.approx(0.3 * 1361.0 * ratio, rel=0.02)
    # Straight below the Sun the up face is square to it.
    assert up.solar.max() == pytest.approx(1361.0, rel=0.02)


@pytest.mark.parametrize("attitude", ["inertial", "nadir", "sun"])
def test_body_axes_are_orthonormal(attitude: str) -> None:
    """Normals of three perpendicular faces are perpendicular unit vectors, right-handed, at every instant."""
    time_s = np.linspace(0.0, 5000.0, 40)
    place, speed = LOW.state(EQUINOX_NS, time_s)
    sun = sun_direction(EQUINOX_NS, time_s)
    x, y, z = (face_normal(attitude, tuple(axis), place, speed, sun) for axis in np.eye(3))
    np.testing.assert_allclose(np.cross(x, y), z, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(z, axis=1), 1.0, atol=1e-12)


def test_an_orbit_through_the_earth_is_refused() -> None:
    """The message names the lowest distance."""
    eccentric = KeplerOrbit(9_000e3, 0.5, 0.0, 0.0, 0.0, 0.0, EQUINOX_NS)
    with pytest.raises(SpecError, match="4500 km of the Earth's centre"):
        face_heat(eccentric, "nadir", (0.0, 0.0, 1.0), EQUINOX_NS, np.zeros(1))
