"""The free vector: what is held never moves, what is free goes there and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import central_difference
from twin_core.errors import ModelError
from twin_core.parameters.parameter import positive, real
from twin_core.parameters.vector import ParameterSet

SET = ParameterSet(
    (
        positive("C:a", "J/K", 9.0e3),
        positive("R:a|space", "m2", 0.24, frozen=True),
        real("T:sink", "K", 250.0, prior_std=50.0),
        positive("G:a|b", "W/K", 2.0, bounds=(0.5, 8.0)),
        real("Q", "W", -4.0),
    )
)
vectors = st.tuples(*(st.floats(-5.0, 5.0) for _ in range(4))).map(np.array)


def test_two_parameters_of_one_name_are_refused() -> None:
    with pytest.raises(ModelError, match="'C:a' stands twice"):
        SET.joined([positive("C:a", "J/K", 1.0)])


def test_the_free_vector_leaves_out_what_is_held() -> None:
    assert SET.free_names == ("C:a", "T:sink", "G:a|b", "Q")
    assert SET.free.shape == (4,)
    assert SET.values.dtype == np.float64
    np.testing.assert_allclose(SET.to_values(SET.free), SET.values, rtol=1e-12)


def test_a_flat_prior_is_infinitely_wide() -> None:
    np.testing.assert_array_equal(SET.prior_std, [1.0, 50.0, 1.0, np.inf])


@given(free=vectors)
def test_held_values_are_untouched_and_bounds_are_kept(free: np.ndarray) -> None:
    values = dict(zip(SET.index, SET.to_values(free), strict=True))
    assert values["R:a|space"] == 0.24
    assert values["C:a"] > 0.0
    assert 0.5 <= values["G:a|b"] <= 8.0
    np.testing.assert_allclose(SET.at_free(free).free, free, rtol=1e-9, atol=1e-9)


@given(free=vectors)
def test_slopes_are_the_diagonal_of_the_central_difference(free: np.ndarray) -> None:
    for position, index in enumerate(SET.free_index):

        def values(x: float, position: int = position) -> np.ndarray:
            moved = free.copy()
            moved[position] = x
            return SET.to_values(moved)

        column = central_difference(values, float(free[position]), 1e-3)
        assert SET.slopes(free)[position] == pytest.approx(column[index], rel=1e-7)
        assert np.abs(np.delete(column, index)).max() == 0.0


def test_updated_ignores_names_that_it_lacks() -> None:
    changed = SET.updated({"Q": 3.0, "nobody": 1.0})
    assert changed.as_dict() == SET.as_dict() | {"Q": 3.0}
    assert len(changed) == len(SET) == 5


def test_an_empty_set_has_an_empty_vector() -> None:
    empty = ParameterSet(())
    assert empty.free.shape == (0,)
    assert empty.to_values(np.zeros(0)).shape == (0,)
    assert empty.slopes(np.zeros(0)).shape == (0,)
