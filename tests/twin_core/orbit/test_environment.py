"""What falls on faces in orbit against simple geometry and the conservation of energy."""

import numpy as np
import pytest

from twin_core.constants import EARTH_RADIUS_M, SOLAR_CONSTANT_W_PER_M2
from twin_core.errors import SpecError
from twin_core.orbit.attitude import FACES, Held, Spinning, Tumbling
from twin_core.orbit.environment import EARTH_INFRARED_W_PER_M2, Environment, face_heat, quantity_units
from twin_core.orbit.path import KeplerOrbit
from twin_core.units import parse_instant_ns

EQUINOX_NS = parse_instant_ns("2026-03-20T14:46:00Z")
LOW = KeplerOrbit(EARTH_RADIUS_M + 500e3, 0.0, 0.0, 0.0, 0.0, 0.0, EQUINOX_NS)
RATIO = (EARTH_RADIUS_M / LOW.semi_major_axis_m) ** 2


def test_eclipse_lasts_as_the_cylinder_says() -> None:
    """Equatorial orbit at equinox: the dark part of the orbit is 2 asin(R / r), to the width of the penumbra."""
    time_s = np.arange(0.0, LOW.period_s, 1.0)
    heat = face_heat(LOW, "sun", (0.0, 0.0, 1.0), EQUINOX_NS, time_s)
    dark = np.mean(heat.solar < 0.5 * heat.solar.max())
    assert dark == pytest.approx(2.0 * np.arcsin(EARTH_RADIUS_M / LOW.semi_major_axis_m) / (2.0 * np.pi), abs=2e-3)


def test_faces_of_a_nadir_pointing_cube() -> None:
    """The down face sees infrared R^2/r^2; the up face none; opposite faces never see the Sun together."""
    time_s = np.linspace(0.0, LOW.period_s, 200)
    down, up = (face_heat(LOW, "orbit", (0.0, 0.0, z), EQUINOX_NS, time_s) for z in (1.0, -1.0))
    np.testing.assert_allclose(down.infrared, EARTH_INFRARED_W_PER_M2 * RATIO, rtol=1e-9)
    assert (up.infrared == 0.0).all() and (up.albedo == 0.0).all()
    assert ((down.solar == 0.0) | (up.solar == 0.0)).all()
    # Below the Sun the whole visible cap is lit; towards its rim, 21.7 degrees away, at a slant.
    assert 0.95 * 0.3 * 1361.0 * RATIO < down.albedo.max() < 0.3 * 1370.0 * RATIO
    # Straight below the Sun the up face is square to it.
    assert up.solar.max() == pytest.approx(1361.0, rel=0.02)


def test_albedo_fades_behind_the_terminator() -> None:
    """Above the terminator it is less than 6 % of its most, some is left beyond, none once no lit ground is in view."""
    time_s = np.arange(0.0, LOW.period_s, 5.0)
    environment = Environment(LOW, Tumbling())
    sky = environment.sky(EQUINOX_NS, time_s)
    albedo = environment.quantities(sky)["albedo_mean"]
    rim = np.sin(np.arccos(1.0 / sky.distance[0]))
    assert (albedo[sky.sun_height < -rim - 1e-3] == 0.0).all()
    twilight = albedo[np.abs(sky.sun_height) < 0.005]
    assert twilight.size and (0.0 < twilight).all() and (twilight < 0.06 * albedo.max()).all()


def test_the_earths_heat_passes_every_sphere_around_it() -> None:
    """Down faces all over a sphere catch what the Earth emits, and all that it reflects: a S pi R^2."""
    heights = np.polynomial.legendre.leggauss(200)
    for altitude_m in (300e3, 2_000e3, 36_000e3):
        orbit = KeplerOrbit(EARTH_RADIUS_M + altitude_m, 0.0, 0.0, 0.0, 0.0, 0.0, EQUINOX_NS)
        time_s = np.linspace(0.0, orbit.period_s, 4001)
        environment = Environment(orbit, Held("orbit"), albedo=0.4, infrared_W_per_m2=200.0)
        sky = environment.sky(EQUINOX_NS, time_s)
        found = environment.quantities(sky)
        sphere = 4.0 * (orbit.semi_major_axis_m / EARTH_RADIUS_M) ** 2  # in areas of the Earth's disc
        np.testing.assert_allclose(found["earth_pz"] * sphere, 4.0 * 200.0, rtol=1e-9)
        order = np.argsort(sky.sun_height)
        by_height = np.interp(heights[0], sky.sun_height[order], (found["albedo_pz"] / sky.sunlight_W_per_m2)[order])
        assert 0.5 * by_height @ heights[1] * sphere == pytest.approx(0.4, rel=2e-3)


def test_sunlight_follows_the_distance() -> None:
    """January is 3.4 % above the year's mean, July 3.3 % below (eccentricity 0.0167)."""
    for instant, factor in (("2026-01-03T17:00:00Z", 1.0 / 0.98331**2), ("2026-07-06T17:00:00Z", 1.0 / 1.01664**2)):
        heat = face_heat(LOW, "sun", (0.0, 0.0, 1.0), parse_instant_ns(instant), np.arange(0.0, LOW.period_s, 60.0))
        assert heat.solar.max() == pytest.approx(SOLAR_CONSTANT_W_PER_M2 * factor, rel=5e-4)


@pytest.mark.parametrize("attitude", [Held("orbit"), Tumbling(), Spinning("sun", (1.0, 0.0, 0.0))])
def test_every_quantity_has_a_unit_and_stays_within_what_it_can_be(attitude: Tumbling) -> None:
    environment = Environment(LOW, attitude)
    found = environment.quantities(environment.sky(EQUINOX_NS, np.linspace(0.0, LOW.period_s, 500)))
    assert found.keys() == quantity_units(attitude.faces).keys()
    for name, series in found.items():
        most = {"sun": 1420.0, "alb": 420.0, "ear": 237.0, "ecl": 1.0, "bet": 90.0}[name[:3]]
        assert (series <= most).all() and (series >= (-90.0 if name == "beta" else 0.0)).all()
    assert {"px", "mx", "py", "my", "pz", "mz"} == set(FACES)


def test_an_orbit_through_the_earth_is_refused() -> None:
    """The message names the lowest distance."""
    eccentric = KeplerOrbit(9_000e3, 0.5, 0.0, 0.0, 0.0, 0.0, EQUINOX_NS)
    with pytest.raises(SpecError, match="4500 km of the Earth's centre"):
        face_heat(eccentric, "orbit", (0.0, 0.0, 1.0), EQUINOX_NS, np.zeros(1))
