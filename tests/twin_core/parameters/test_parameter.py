"""One parameter: positive or bounded by construction, and its number in the solver."""

import math

import pytest

from twin_core.parameters.parameter import GUESS_LOG_STD, absolute_temperature, positive, real
from twin_core.parameters.transforms import Identity, Log, LogInterval


def test_a_positive_parameter_runs_along_its_logarithm() -> None:
    parameter = positive("C:a", "J/K", 2.0e4)
    assert isinstance(parameter.transform, Log)
    assert parameter.free == pytest.approx(math.log(2.0e4))
    assert parameter.prior_std == GUESS_LOG_STD
    assert not parameter.frozen


def test_bounds_make_an_interval() -> None:
    parameter = positive("G:a|b", "W/K", 2.0, bounds=(1.0, 4.0))
    assert parameter.transform == LogInterval(1.0, 4.0)
    assert parameter.free == pytest.approx(0.0, abs=1e-12)  # 2 is the geometric middle of 1 and 4


def test_a_real_parameter_takes_either_sign() -> None:
    parameter = real("T:sink", "K", -3.0)
    assert isinstance(parameter.transform, Identity)
    assert (parameter.free, parameter.prior_std) == (-3.0, None)


def test_at_changes_the_value_alone() -> None:
    parameter = positive("C:a", "J/K", 1.0, frozen=True, guessed=True)
    moved = parameter.at(7.0)
    assert (moved.value, moved.name, moved.frozen, moved.guessed) == (7.0, "C:a", True, True)
    assert parameter.value == 1.0


def test_an_absolute_temperature_counts_in_kelvin_down_to_zero() -> None:
    """Its prior is the Gaussian that was declared; a step below absolute zero ends there."""
    parameter = absolute_temperature("T:sink", 3.0, prior_std_K=1.0)
    assert (parameter.free, parameter.prior_std, parameter.transform.lowest) == (3.0, 1.0, 0.0)
    assert [parameter.transform.to_value(free) for free in (250.0, 3.0, -90.0)] == [250.0, 3.0, 0.0]
