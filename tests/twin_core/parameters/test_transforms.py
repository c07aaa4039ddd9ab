"""Bijections: inverse, increasing, bounded, with slopes equal to central differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import central_difference
from twin_core.parameters.transforms import Bounded, Identity, Log, LogInterval, Shifted, Transform, is_logarithmic

INTERVAL = LogInterval(2.0e-3, 50.0)
TRANSFORMS: tuple[Transform, ...] = (Identity(), Log(), INTERVAL, Shifted(40.0, 8.0), Bounded(-30.0))
each_transform = pytest.mark.parametrize("transform", TRANSFORMS, ids=lambda t: type(t).__name__)


@each_transform
@given(free=st.floats(-8.0, 8.0))
def test_to_free_inverts_to_value(transform: Transform, free: float) -> None:
    # A logistic at 8 has used up 3 of the 16 digits.
    assert transform.to_free(transform.to_value(free)) == pytest.approx(free, rel=1e-10, abs=1e-10)


@given(value=st.floats(1e-12, 1e12))
def test_log_reaches_every_positive_value(value: float) -> None:
    assert Log().to_value(Log().to_free(value)) == pytest.approx(value, rel=1e-12)


@given(share=st.floats(1e-5, 1.0 - 1e-5))
def test_interval_reaches_every_value_inside(share: float) -> None:
    value = INTERVAL.lower * (INTERVAL.upper / INTERVAL.lower) ** share
    assert INTERVAL.to_value(INTERVAL.to_free(value)) == pytest.approx(value, rel=1e-9)


@each_transform
@given(free=st.floats(-6.0, 6.0))
def test_slope_is_the_central_difference(transform: Transform, free: float) -> None:
    difference = central_difference(lambda x: np.array(transform.to_value(x)), free, 1e-3)
    assert transform.slope(free) == pytest.approx(float(difference), rel=1e-8)


@each_transform
@given(free=st.floats(-20.0, 20.0), more=st.floats(1e-3, 10.0))
def test_values_increase(transform: Transform, free: float, more: float) -> None:
    assert transform.to_value(free + more) >= transform.to_value(free)
    assert transform.slope(free) > 0.0


@given(free=st.floats(-1e6, 1e6))
def test_no_trial_step_leaves_the_admissible_values(free: float) -> None:
    assert np.isfinite(Log().to_value(free)) and Log().to_value(free) > 0.0
    rounding = 1.0 + 1e-12
    assert INTERVAL.lower / rounding <= INTERVAL.to_value(free) <= INTERVAL.upper * rounding


@given(free=st.floats(-1e6, 1e6))
def test_a_positive_value_reaches_its_bounds_and_goes_no_further(free: float) -> None:
    bounded = Log(upper=8.0, lower=0.5)
    assert bounded.to_value(free) == pytest.approx(min(max(np.exp(np.clip(free, -9.0, 9.0)), 0.5), 8.0))
    assert (bounded.to_value(bounded.lowest), bounded.to_value(bounded.highest)) == pytest.approx((0.5, 8.0))
    assert (Log().lowest, Log().highest) == (-np.inf, np.inf)


@pytest.mark.parametrize("value", [INTERVAL.lower, INTERVAL.upper])
def test_a_guess_on_a_bound_can_still_move(value: float) -> None:
    free = INTERVAL.to_free(value)
    assert np.isfinite(free)
    assert INTERVAL.to_value(free) == pytest.approx(value, rel=2e-5)
    assert INTERVAL.slope(free) > 0.0


@given(seconds=st.floats(0.0, 1e5))
def test_an_instant_keeps_its_microseconds_and_its_conditioning(seconds: float) -> None:
    transform = Shifted(1.77e9, 5.0e4)
    free = transform.to_free(1.77e9 + seconds)
    assert 0.0 <= free <= 2.0 + 1e-9
    assert transform.to_value(free) == pytest.approx(1.77e9 + seconds, rel=0.0, abs=1e-6)


@given(free=st.floats(-1e6, 0.0))
def test_a_floored_number_rests_on_its_bound_and_can_come_back(free: float) -> None:
    assert Bounded(0.0).to_value(free) == 0.0
    assert Bounded(0.0).slope(free) == 1.0


def test_what_moves_by_factors() -> None:
    assert [is_logarithmic(t) for t in TRANSFORMS] == [False, True, True, False, False]
