"""Quantities over steps: the heat of an orbit is that of a fine sum, however long the steps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin_core._typing import FloatArray
from twin_core.constants import EARTH_RADIUS_M
from twin_core.orbit import means
from twin_core.orbit.attitude import Attitude, Commanded, Held, Spinning, Tumbling
from twin_core.orbit.environment import Environment
from twin_core.orbit.means import over_steps
from twin_core.orbit.path import KeplerOrbit
from twin_core.units import parse_instant_ns

EPOCH_NS = parse_instant_ns("2016-02-04T00:00:00Z")
LOW = KeplerOrbit(EARTH_RADIUS_M + 630e3, 0.006, 97.7, 94.3, 98.0, 262.7, EPOCH_NS)
ENDS, MIDDLE = np.array([0.0, 1.0]), np.array([0.5])
ATTITUDES: dict[str, Attitude] = {
    "nadir": Held("orbit"),
    "sun": Held("sun"),
    "inertial": Held("inertial", (0.5, 0.5, 0.5, 0.5)),
    "spinning": Spinning("inertial", (0.2, 0.3, 0.9)),
    "tumbling": Tumbling(),
    "commanded": Commanded("orbit", np.array([0.0, 6e3]), np.array([[1.0, 0, 0, 0], [0.0, 0, 0, 1.0]])),
}


def even(step_s: float, duration_s: float) -> tuple[FloatArray, FloatArray]:
    begin_s = np.arange(0.0, duration_s - 1e-6, step_s)
    return begin_s, np.minimum(step_s, duration_s - begin_s)


def fine_sum(environment: Environment, duration_s: float) -> dict[str, float]:
    """Return the integral of every quantity by the midpoint rule at a tenth of a second."""
    time_s = (np.arange(round(duration_s * 10.0)) + 0.5) * duration_s / round(duration_s * 10.0)
    return {
        name: float(series.mean() * duration_s)
        for name, series in environment.quantities(environment.sky(EPOCH_NS, time_s)).items()
    }


@pytest.mark.parametrize("name", ATTITUDES)
@pytest.mark.parametrize("step_s", [7.0, 60.0, 600.0])
def test_no_heat_is_lost_over_an_orbit(name: str, step_s: float) -> None:
    """Within 1e-4 of the heat of an orbit on the face that gets most of its kind (asked for are 1e-3)."""
    environment = Environment(LOW, ATTITUDES[name])
    begin_s, lengths_s = even(step_s, LOW.period_s)
    exact = fine_sum(environment, LOW.period_s)
    for quantity, lines in over_steps(environment, EPOCH_NS, begin_s, lengths_s, ENDS).items():
        kind = quantity.partition("_")[0]
        most = max(abs(value) for other, value in exact.items() if other.startswith(kind))
        assert lines.mean(axis=1) @ lengths_s == pytest.approx(exact[quantity], abs=1e-4 * most), quantity


def test_a_line_has_the_mean_and_the_first_moment_of_its_step() -> None:
    """Against sums over each step, but where a face turns away in it or the line would leave its range."""
    environment = Environment(LOW, Held("orbit"))
    begin_s, step_s = np.array([3000.0, 3100.0, 4200.0]), np.array([40.0, 55.0, 240.0])
    lines = over_steps(environment, EPOCH_NS, begin_s, step_s, ENDS)
    for k in range(3):
        share = (np.arange(4000) + 0.5) / 4000
        sky = environment.sky(EPOCH_NS, begin_s[k] + step_s[k] * share)
        assert sky.sunlit.min() == 1.0
        for name, series in environment.quantities(sky).items():
            if series.min() == 0.0 < series.max():
                continue
            first, last = lines[name][k]
            scale = max(float(np.abs(series).max()), 1e-9)
            assert 0.5 * (first + last) == pytest.approx(series.mean(), abs=1e-5 * scale)
            moment = float(((share - 0.5) * series).mean())
            if abs(12.0 * moment) < 1.99 * series.mean():
                assert (last - first) / 12.0 == pytest.approx(moment, abs=1e-5 * scale), name


@settings(max_examples=25, deadline=None)
@given(
    st.floats(250.0, 2000.0),
    st.floats(0.0, 180.0),
    st.floats(0.0, 360.0),
    st.floats(5.0, 1500.0),
)
def test_eclipses_of_any_orbit_keep_their_length(altitude_km: float, tilt: float, node: float, step_s: float) -> None:
    """Also those that the Sun only grazes, and steps longer than an eclipse; and nothing is ever negative."""
    orbit = KeplerOrbit(EARTH_RADIUS_M + 1e3 * altitude_km, 0.0, tilt, node, 0.0, 0.0, EPOCH_NS)
    environment = Environment(orbit, Tumbling())
    begin_s, lengths_s = even(step_s, orbit.period_s)
    lines = over_steps(environment, EPOCH_NS, begin_s, lengths_s, ENDS)
    time_s = (np.arange(20_000) + 0.5) * orbit.period_s / 20_000
    dark_s = float(np.mean(1.0 - environment.sky(EPOCH_NS, time_s).sunlit)) * orbit.period_s
    assert lines["eclipse"].mean(axis=1) @ lengths_s == pytest.approx(dark_s, abs=0.5)
    for name, line in lines.items():
        assert name == "beta" or line.min() >= 0.0, name
    assert lines["eclipse"].max() <= 1.0 + 1e-12


def test_portions_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps are computed portion by portion: the same numbers, also where one step alone is a portion."""
    environment = Environment(LOW, Tumbling())
    begin_s, step_s = np.array([0.0, 60.0, 5000.0, 5010.0]), np.array([60.0, 4940.0, 10.0, 300.0])
    whole = over_steps(environment, EPOCH_NS, begin_s, step_s, MIDDLE)
    monkeypatch.setattr(means, "AT_ONCE", 3)
    for name, line in over_steps(environment, EPOCH_NS, begin_s, step_s, MIDDLE).items():
        np.testing.assert_array_equal(line, whole[name])


def test_no_steps_give_no_lines() -> None:
    """A record of a single sample has no step."""
    lines = over_steps(Environment(LOW, Tumbling()), EPOCH_NS, np.zeros(0), np.zeros(0), ENDS)
    assert all(line.shape == (0, 2) for line in lines.values()) and "eclipse" in lines
