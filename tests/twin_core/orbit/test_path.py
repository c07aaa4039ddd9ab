"""Keplerian orbits against the two-body equation and Kepler's laws."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.constants import EARTH_GM_M3_PER_S2, EARTH_RADIUS_M
from twin_core.orbit.path import EARTH_J2, KeplerOrbit, solve_kepler
from twin_core.units import parse_instant_ns

EPOCH_NS = parse_instant_ns("2026-03-01T00:00:00Z")


def test_keplers_equation_is_solved() -> None:
    """E - e sin E = M for any eccentricity."""
    mean = np.linspace(-10.0, 10.0, 101)
    for eccentricity in (0.0, 0.3, 0.9):
        anomaly = solve_kepler(mean, eccentricity)
        np.testing.assert_allclose(anomaly - eccentricity * np.sin(anomaly), mean, atol=1e-12)


def test_short_arc_equals_integration_with_oblateness_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without J2 the orbit is the solution of the two-body equation, by SciPy, to a metre over a revolution."""
    monkeypatch.setattr("twin_core.orbit.path.EARTH_J2", 0.0)
    orbit = KeplerOrbit(7_500e3, 0.05, 63.0, 40.0, 110.0, 20.0, EPOCH_NS)
    times_s = np.linspace(0.0, orbit.period_s, 30)
    place, speed = orbit.state(EPOCH_NS, times_s)

    def pull(t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[3:], -EARTH_GM_M3_PER_S2 * y[:3] / np.linalg.norm(y[:3]) ** 3])

    start = np.concatenate([place[0], speed[0]])
    exact = solve_ivp(pull, (0.0, times_s[-1]), start, t_eval=times_s, rtol=1e-11, atol=1e-6, method="DOP853").y.T
    np.testing.assert_allclose(place, exact[:, :3], atol=1.0)
    np.testing.assert_allclose(speed, exact[:, 3:], atol=1e-3)


def test_node_of_a_sun_synchronous_orbit_turns_with_the_sun() -> None:
    """At 700 km and 98.19 degrees the node drifts 360 degrees in a year."""
    orbit = KeplerOrbit(EARTH_RADIUS_M + 700e3, 0.0, 98.19, 0.0, 0.0, 0.0, EPOCH_NS)
    ends = orbit.state(EPOCH_NS, np.array([0.0, 30 * 86_400.0]))
    poles = np.cross(*ends)
    node_deg = np.degrees(np.arctan2(poles[:, 0], -poles[:, 1]))
    assert (node_deg[1] - node_deg[0]) / 30.0 == pytest.approx(360.0 / 365.24, rel=0.01)
    assert EARTH_J2 > 0.0
