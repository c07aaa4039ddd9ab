"""Where the Sun stands, against the calendar and against the IAU's own software."""

import erfa
import numpy as np

from twin_core.orbit.sun import sun_direction
from twin_core.units import parse_instant_ns, sun_distance_au


def test_sun_stands_on_the_equator_at_equinox_and_on_the_tropic_at_solstice() -> None:
    """Declination 0 at the equinox of 2026 and 23.44 degrees at the solstice, to 0.02 degrees."""
    for instant, declination_deg in (("2026-03-20T14:46:00Z", 0.0), ("2026-06-21T08:25:00Z", 23.44)):
        z = sun_direction(parse_instant_ns(instant), np.zeros(1))[0, 2]
        np.testing.assert_allclose(np.degrees(np.arcsin(z)), declination_deg, atol=0.02)


def test_direction_and_distance_agree_with_erfa() -> None:
    """Forty years: 0.011 degrees of the apparent Sun in TEME, where SGP4 answers, and 1e-4 of the distance.

    ERFA: Earth by VSOP (epv00), precession and nutation IAU 2006/2000A, and the equation of the equinoxes, by which the
    mean equinox of date lies off the true one. What the Earth's own speed turns the light by is added by hand.
    """
    time_s = np.arange(0.0, 40.0 * 365.25 * 86_400.0, 7.3 * 86_400.0)
    days = (time_s + 64.184) / 86_400.0  # terrestrial time, which the formula may take for UTC
    earth = erfa.epv00(2_451_545.0, days)[0]
    away_au = np.linalg.norm(earth["p"], axis=1)
    apparent = -earth["p"] / away_au[:, None] + earth["v"] / 173.1446  # AU per day: the speed of light
    true = np.einsum("tij,tj->ti", erfa.pnm06a(2_451_545.0, days), apparent)
    cos, sin = np.cos(erfa.ee06a(2_451_545.0, days)), np.sin(erfa.ee06a(2_451_545.0, days))
    peer = np.stack([cos * true[:, 0] + sin * true[:, 1], cos * true[:, 1] - sin * true[:, 0], true[:, 2]], axis=1)
    peer /= np.linalg.norm(peer, axis=1)[:, None]
    epoch_ns = parse_instant_ns("2000-01-01T12:00:00Z")
    off_deg = np.degrees(np.linalg.norm(sun_direction(epoch_ns, time_s) - peer, axis=1))
    assert off_deg.max() < 0.011
    np.testing.assert_allclose(sun_distance_au(epoch_ns, time_s), away_au, rtol=1e-4)
