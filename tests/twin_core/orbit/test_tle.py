"""Element sets against published positions, and every way in which a line can be wrong."""

import numpy as np
import pytest

from twin_core.constants import EARTH_GM_M3_PER_S2, EARTH_RADIUS_M
from twin_core.errors import SpecError
from twin_core.orbit.tle import TleOrbit, check_lines
from twin_core.units import format_instant, parse_instant_ns

# International Space Station, an element set of 2008 that SGP4's documentation prints.
ISS = (
    "1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927",
    "2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537",
)
# Vanguard 1, the first case of the verification set of Vallado et al., AIAA 2006-6753.
VANGUARD = (
    "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753",
    "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667",
)


def test_positions_are_the_published_ones() -> None:
    """Table of AIAA 2006-6753 at 0, 360 and 4320 minutes after the epoch, km; dates are kept to a microsecond."""
    orbit = TleOrbit(*VANGUARD)
    place_m, speed_m_per_s = orbit.state(orbit.epoch_ns, 60.0 * np.array([0.0, 360.0, 4320.0]))
    published_km = [
        [7022.46529266, -1400.08296755, 0.03995155],
        [-7154.03120202, -3783.17682504, -3536.19412294],
        [-9060.47373569, 4658.70952502, 813.68673153],
    ]
    np.testing.assert_allclose(place_m / 1e3, published_km, atol=1e-4)
    np.testing.assert_allclose(speed_m_per_s[0] / 1e3, [1.893841015, 6.405893759, 4.534807250], atol=1e-7)


def test_epoch_and_period_are_read() -> None:
    """Day 264.51782528 of 2008, 15.72125391 revolutions a day."""
    orbit = TleOrbit(*ISS)
    assert abs(orbit.epoch_ns - parse_instant_ns("2008-09-20T12:25:40.104192Z")) < 20_000
    assert format_instant(orbit.epoch_ns).startswith("2008-09-20T12:25:40")
    assert orbit.period_s == pytest.approx(86_400.0 / 15.72125391, rel=1e-6)


def test_state_obeys_the_vis_viva_equation() -> None:
    """Height and inclination of the station; its energy is that of a Keplerian orbit to the size of the oblateness."""
    epoch_ns = parse_instant_ns("2008-09-20T12:25:40Z")
    place, speed = TleOrbit(*ISS).state(epoch_ns, np.linspace(0.0, 5400.0, 20))
    radius = np.linalg.norm(place, axis=1)
    assert ((radius > EARTH_RADIUS_M + 330e3) & (radius < EARTH_RADIUS_M + 370e3)).all()
    pole = np.cross(place, speed)
    tilt_deg = np.degrees(np.arccos(pole[:, 2] / np.linalg.norm(pole, axis=1)))
    np.testing.assert_allclose(tilt_deg, 51.64, atol=0.1)
    energy = 0.5 * np.sum(speed**2, axis=1) - EARTH_GM_M3_PER_S2 / radius
    np.testing.assert_allclose(energy / energy[0], 1.0, atol=2e-3)


def test_a_decayed_orbit_is_refused() -> None:
    """A century later the station has decayed: a clear error instead of NaN."""
    with pytest.raises(SpecError, match="cannot propagate to these dates"):
        TleOrbit(*ISS).state(parse_instant_ns("2108-01-01T00:00:00Z"), np.zeros(2))


def with_checksum(line: str) -> str:
    """Return a line with its last digit as it must be: the sum of its digits, a minus counting one."""
    total = sum(int(c) if c.isdigit() else int(c == "-") for c in line[:68])
    return line[:68] + str(total % 10)


def test_published_lines_have_the_checksum_that_is_computed_here() -> None:
    for line in (*ISS, *VANGUARD):
        assert with_checksum(line) == line


@pytest.mark.parametrize(
    ("line_1", "line_2", "fault"),
    [
        ("nonsense", ISS[1], r"tle\[0\]: line 1 must have 69 characters and begin with '1 '"),
        (ISS[1], ISS[0], r"tle\[0\]: line 1 must have 69 characters and begin with '1 '"),
        (ISS[0], ISS[1][:-1], r"tle\[1\]: line 2 must have 69 characters"),
        (ISS[0], ISS[1].replace("51.6416", "52.6416"), r"tle\[1\]: checksum of line 2 is 7, must be 8"),
        (ISS[0], with_checksum(ISS[1].replace("51.6416", "51.64O6")), r"inclination \(line 2, columns 9 to 16\)"),
        (ISS[0], with_checksum(ISS[1].replace("0006703", "000.703")), r"eccentricity .* cannot be '000.703'"),
        (with_checksum(ISS[0].replace("08264.5", "08x64.5")), ISS[1], r"day of the epoch .* cannot be 'x64.51782528'"),
        (VANGUARD[0], ISS[1], "lines of two satellites, '00005' and '25544'"),
    ],
)
def test_broken_lines_are_refused_by_name(line_1: str, line_2: str, fault: str) -> None:
    with pytest.raises(SpecError, match=fault):
        check_lines(line_1, line_2)


def test_signs_and_leading_zeros_are_taken() -> None:
    """Other writers of element sets put a plus and fill up with zeros."""
    line_1 = with_checksum(VANGUARD[0].replace("  .00000023  00000-0  28098-4", " +.00000023 +00000-0 +28098-4"))
    line_2 = with_checksum(VANGUARD[1].replace(" 34.2682", "034.2682"))
    places = [
        TleOrbit(*lines).state(TleOrbit(*VANGUARD).epoch_ns, np.zeros(1))[0] for lines in (VANGUARD, (line_1, line_2))
    ]
    np.testing.assert_array_equal(*places)
