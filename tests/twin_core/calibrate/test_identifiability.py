"""What the data cannot see, in words."""

import numpy as np

from twin_core.calibrate.identifiability import unseen_parameters, weakest_direction, words
from twin_core.parameters.parameter import positive, real
from twin_core.parameters.vector import ParameterSet

SET = ParameterSet(
    (positive("C:a", "J/K", 1e4), positive("R", "m2", 1.0, frozen=True), positive("G", "W/K", 2.0), real("Q", "W", 5.0))
)


def test_a_factor_e_of_uncertainty_is_not_seen() -> None:
    assert unseen_parameters(SET, np.array([0.1, 0.2, 1.0])) == []
    assert unseen_parameters(SET, np.array([1.1, 0.2, 1.0])) == ["C:a"]
    assert unseen_parameters(SET, np.array([0.1, np.nan, 6.0])) == ["G", "Q"]


def test_a_ratio_that_alone_is_told_is_said() -> None:
    """C and G are each uncertain by a factor, their ratio is not: the weak direction is both as one."""
    spread, tight = 0.5**2, 1e-4
    covariance = np.diag([tight, tight, 1.0])
    covariance[:2, :2] += spread * np.ones((2, 2))
    said = weakest_direction(SET, covariance)
    assert said is not None and "C:a" in said and "G" in said and "Q" not in said
    assert weakest_direction(SET, 1e-4 * np.eye(3)) is None
    assert weakest_direction(SET, np.diag([4.0, 1e-4, 1e-4])) is None  # one alone is no combination


def test_words_are_silent_where_all_is_seen() -> None:
    assert words(SET, 1e-4 * np.eye(3)) == []
    assert any("C:a" in line for line in words(SET, np.diag([4.0, 1e-4, 1e-4])))


def test_nothing_free_is_nothing_to_say() -> None:
    assert words(ParameterSet(()), np.zeros((0, 0))) == []
