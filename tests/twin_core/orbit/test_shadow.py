"""The shadow against rays to all of the Sun's disc, and against the closed form of a circular orbit's eclipse."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin_core._typing import FloatArray
from twin_core.constants import ASTRONOMICAL_UNIT_M, EARTH_RADIUS_M
from twin_core.orbit.path import KeplerOrbit
from twin_core.orbit.shadow import SUN_RADIUS_M, apparent_discs, visible_share
from twin_core.orbit.sky import sky_at
from twin_core.units import parse_instant_ns

EQUINOX_NS = parse_instant_ns("2026-03-20T14:46:00Z")
AWAY_M = np.array([ASTRONOMICAL_UNIT_M])


def lit(place_m: FloatArray, sun: FloatArray) -> float:
    return float(visible_share(*apparent_discs(place_m[None], sun[None], AWAY_M))[0])


def test_shadow_has_umbra_penumbra_and_light() -> None:
    """Behind the Earth: dark on the axis, half of the disc where its centre touches the limb, light beyond."""
    behind_m = 7_000e3
    limb, half_disc = np.arcsin(EARTH_RADIUS_M / behind_m), SUN_RADIUS_M / ASTRONOMICAL_UNIT_M

    def at(angle: float) -> float:
        return lit(behind_m * np.array([-np.cos(angle), np.sin(angle), 0.0]), np.array([1.0, 0.0, 0.0]))

    assert at(0.0) == at(limb - 1.1 * half_disc) == 0.0
    assert at(limb + 1.1 * half_disc) == at(np.pi) == 1.0
    assert at(limb) == pytest.approx(0.5, abs=0.01)
    inside = [at(limb + x * half_disc) for x in np.linspace(-0.99, 0.99, 21)]
    assert (np.diff(inside) > 0.0).all()


def test_far_behind_the_earth_a_ring_is_left() -> None:
    """From beyond the tip of the umbra the Earth covers the square of the ratio of the discs' radii."""
    away_m = 3e9
    share = lit(np.array([-away_m, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    discs = (EARTH_RADIUS_M / away_m) / (SUN_RADIUS_M / (ASTRONOMICAL_UNIT_M + away_m))
    assert share == pytest.approx(1.0 - discs**2, rel=1e-3)


@settings(deadline=None)
@given(st.floats(6.6e6, 4.3e7), st.floats(0.0, np.pi / 2.0), st.floats(-0.4, 0.4), st.floats(0.0, 2.0 * np.pi))
def test_light_is_the_share_of_rays_that_pass_the_earth(
    radius_m: float, angle: float, south: float, turn: float
) -> None:
    """Rays from the spacecraft to points all over the Sun's disc: those that meet the sphere are dark.

    The place is where the shadow's edge is, as far off as a few discs: elsewhere there is nothing to see.
    """
    sun = np.array([np.cos(south), 0.0, np.sin(south)])
    aside = np.cross(sun, [0.0, 1.0, 0.0]) * np.sin(turn) + np.array([0.0, np.cos(turn), 0.0])
    half_disc = SUN_RADIUS_M / ASTRONOMICAL_UNIT_M
    off_axis = np.arcsin(EARTH_RADIUS_M / radius_m) + 1.5 * half_disc * np.cos(2.0 * angle)
    place = radius_m * (-np.cos(off_axis) * sun + np.sin(off_axis) * aside)
    to_sun = ASTRONOMICAL_UNIT_M * sun - place
    across = np.linalg.svd(to_sun[None])[2][1:]
    ring, spoke = np.sqrt((np.arange(60) + 0.5) / 60), 2.0 * np.pi * (np.arange(60) + 0.5) / 60
    disc = SUN_RADIUS_M * ring[:, None, None] * np.stack([np.cos(spoke), np.sin(spoke)], axis=-1)
    rays = to_sun + disc @ across
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    miss_m = np.linalg.norm(np.cross(place, rays), axis=-1)
    passes = (rays @ place > 0.0) | (miss_m > EARTH_RADIUS_M)
    assert lit(place, sun) == pytest.approx(passes.mean(), abs=0.02)


@pytest.mark.parametrize("altitude_km", [400.0, 800.0, 20_200.0, 35_786.0])
@pytest.mark.parametrize("inclination_deg", [0.0, 30.0, 51.6, 60.0])
def test_eclipse_lasts_as_the_closed_form_says(altitude_km: float, inclination_deg: float) -> None:
    """Circular orbit whose angle to the Sun is its inclination: dark for acos(sqrt(H^2 - 1) / (H cos beta)) / pi of it.

    Gilmore, Spacecraft Thermal Control Handbook, 2nd edition, chapter 2 (cylindrical shadow of a sphere). The umbra is a
    cone, the penumbra as wide again: half of the disc hidden lasts as the cylinder does.
    """
    radius_m = EARTH_RADIUS_M + 1e3 * altitude_km
    orbit = KeplerOrbit(radius_m, 0.0, inclination_deg, 90.0, 0.0, 0.0, EQUINOX_NS)
    time_s = np.arange(0.0, orbit.period_s, orbit.period_s / 20_000)
    sky = sky_at(orbit, EQUINOX_NS, time_s)
    beta = np.radians(np.abs(sky.beta_deg).mean())
    assert np.degrees(beta) == pytest.approx(inclination_deg, abs=1.1)  # the Sun moves while the orbit goes round
    H = radius_m / EARTH_RADIUS_M
    ratio = np.sqrt(H**2 - 1.0) / (H * np.cos(beta))
    closed = float(np.arccos(min(ratio, 1.0)) / np.pi)
    assert np.mean(1.0 - sky.sunlit) == pytest.approx(closed, abs=5e-4)
