"""Newton steps within bounds, against SciPy's bounded least squares."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from twin_core.calibrate.bounded import bounded_step


def newton(hessian: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    return -np.linalg.solve(hessian, gradient)


def random_problem(seed: int, n: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    design, target = rng.normal(size=(12, n)), rng.normal(size=12)
    return design, target, design.T @ design, -design.T @ target


@given(seed=st.integers(0, 500))
def test_without_bounds_it_is_the_newton_step(seed: int) -> None:
    _, _, hessian, gradient = random_problem(seed)
    free = np.full(4, np.inf)
    np.testing.assert_array_equal(bounded_step(newton, hessian, gradient, -free, free), newton(hessian, gradient))


@given(seed=st.integers(0, 500), low=st.floats(-1.0, 0.0), high=st.floats(0.01, 1.0))
def test_one_bounded_unknown_leaves_the_best_step_of_the_others(seed: int, low: float, high: float) -> None:
    design, target, hessian, gradient = random_problem(seed)
    lowest, highest = np.full(4, -np.inf), np.full(4, np.inf)
    lowest[1], highest[1] = low, high
    expected = lsq_linear(design, target, (lowest, highest), tol=1e-13).x
    np.testing.assert_allclose(bounded_step(newton, hessian, gradient, lowest, highest), expected, atol=1e-5)


@given(seed=st.integers(0, 500), reach=st.floats(1e-3, 0.5))
def test_no_component_leaves_its_bounds_and_the_free_ones_have_no_slope_left(seed: int, reach: float) -> None:
    _, _, hessian, gradient = random_problem(seed)
    step = bounded_step(newton, hessian, gradient, np.full(4, -reach), np.full(4, reach))
    assert np.abs(step).max() <= reach
    np.testing.assert_allclose((gradient + hessian @ step)[np.abs(step) < reach], 0.0, atol=1e-9)


def test_where_all_are_held_nothing_is_solved_for() -> None:
    step = bounded_step(newton, np.eye(2), np.array([5.0, -5.0]), np.zeros(2), np.ones(2))
    assert step == pytest.approx(np.array([0.0, 1.0]))
