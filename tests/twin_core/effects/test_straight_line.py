"""A property that is a straight line over temperature stays positive wherever the training record has been."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from twin_core.effects.straight_line import range_of_slope, slope_spec

TEMPERATURES_K = st.lists(st.floats(150.0, 400.0), min_size=2, max_size=20, unique=True)


@given(temperatures=TEMPERATURES_K, slope=st.floats(-10.0, 10.0), least=st.sampled_from([0.0, 0.2]))
def test_the_line_stays_above_its_least_share(temperatures: list[float], slope: float, least: float) -> None:
    temperature_K = np.array(temperatures)
    reference_K = float(temperature_K.mean())
    transform = slope_spec("beta_per_K", range_of_slope(temperature_K, reference_K, least)).transform
    kept = transform.to_value(slope)
    line = 1.0 + kept * (temperature_K - reference_K)
    assert line.min() >= least - 1e-9
    if (1.0 + slope * (temperature_K - reference_K)).min() >= least + 1e-9:
        assert kept == slope


def test_without_a_training_record_there_is_no_range() -> None:
    assert slope_spec("kappa_per_K", {"T_ref_K": 290.0}).transform.to_value(7.0) == 7.0


def test_one_temperature_alone_tells_no_range() -> None:
    assert range_of_slope(np.full(3, 300.0), 300.0) == {}
