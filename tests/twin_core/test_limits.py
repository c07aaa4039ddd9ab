"""Limits against a plain loop over the readings, and forecasts of straight lines whose crossing is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin_core.anomaly.limits import REPEATS, Crossing, reaches, watch

LIMIT, BAND = 40.0, 1.0
LEVELS = [30.0, 38.5, 39.5, 40.0, 40.5, 45.0, float("nan")]


def plainly(values: list[float], sign: float = 1.0) -> list[tuple[int, int | None, float]]:
    """Follow readings one by one, as a person would: two beyond raise it, two back by the band end it."""
    found: list[list] = []
    is_open, streak = False, []
    for time, value in enumerate(values):
        if np.isnan(value):
            continue
        excess = sign * (value - LIMIT)
        hit = excess < -BAND if is_open else excess > 0
        if is_open:
            found[-1][2] = max(found[-1][2], excess)
        streak = [*streak, (time, excess)] if hit else []
        if len(streak) == REPEATS:
            if is_open:
                found[-1][1] = streak[0][0]
            else:
                found.append([streak[0][0], None, max(e for _, e in streak)])
            is_open, streak = not is_open, []
    return [(start, stop, LIMIT + sign * worst) for start, stop, worst in found]


@given(st.lists(st.sampled_from(LEVELS), max_size=60), st.lists(st.integers(0, 60), max_size=5), st.booleans())
def test_any_cut_gives_what_a_plain_loop_gives(values: list[float], cuts: list[int], is_low: bool) -> None:
    series = np.array([2 * LIMIT - v if is_low else v for v in values])
    state: dict = {}
    told: dict[int, Crossing] = {}
    for part in np.split(np.arange(series.size), sorted(min(cut, series.size) for cut in cuts)):
        state, found = watch(state, LIMIT, "low" if is_low else "high", BAND, part, series[part])
        told |= {crossing.start: crossing for crossing in found}
    expected = plainly(list(series), -1.0 if is_low else 1.0)
    assert [(c.start, c.stop, c.worst) for c in told.values()] == expected


def test_a_cut_in_the_middle_of_what_raises_an_alarm_loses_nothing() -> None:
    state, _ = watch({}, LIMIT, "high", BAND, np.array([0, 1]), np.array([30.0, 45.0]))
    _, found = watch(state, LIMIT, "high", BAND, np.array([2]), np.array([40.5]))
    assert found == [Crossing(1, None, 45.0)]


def test_one_reading_raises_nothing_and_chatter_is_one_alarm() -> None:
    assert watch({}, LIMIT, "high", BAND, np.arange(5), np.array([30, 99, 30, 99, 30.0]))[1] == []
    chatter = np.array([30, 41, 41, 39.5, 39.5, 41, 39.5, 39.5, 41, 30, 30.0])
    _, found = watch({}, LIMIT, "high", BAND, np.arange(11), chatter)
    assert found == [Crossing(1, 9, 41.0)]


@pytest.mark.parametrize("side", ["high", "low"])
def test_a_straight_line_reaches_its_limit_when_it_does(side: str) -> None:
    """Mean 20 K + 0.01 K/s with bands of 4 K on both sides: the limit of 40 K is met at 2000 s, and 400 s around it."""
    time_s = np.arange(60.0, 7200.0, 60.0)
    sign = 1.0 if side == "high" else -1.0
    mean = sign * (20.0 + 0.01 * time_s)
    quantiles = {0.05: mean - 4.0, 0.5: mean, 0.95: mean + 4.0}
    found = reaches(time_s, quantiles, sign * 40.0, side)  # type: ignore[arg-type]
    np.testing.assert_allclose([found.expected_s, found.earliest_s, found.latest_s], [2000.0, 1600.0, 2400.0])
    beyond = reaches(time_s, quantiles, sign * 93.0, side)  # type: ignore[arg-type]
    assert (beyond.expected_s, beyond.latest_s) == (None, None) and beyond.earliest_s == pytest.approx(6900.0)
    assert reaches(time_s, quantiles, sign * 10.0, side).expected_s == 60.0  # type: ignore[arg-type]
