"""The compiled recursions against the scheme written down with dense solves."""

import numpy as np
import pytest

from twin_core.simulate.kernels import GAMMA, march, march_sensitivities


def scheme(step: float, jacobian: np.ndarray, constant: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Alexander's two stages for f(Y) = g + J Y, (2, n)."""
    identity = np.eye(state.size)
    first = np.linalg.solve(identity - GAMMA * step * jacobian[0], state + GAMMA * step * constant[0])
    slope = constant[0] + jacobian[0] @ first
    middle = state + (1.0 - GAMMA) * step * slope + GAMMA * step * constant[1]
    return np.array([first, np.linalg.solve(identity - GAMMA * step * jacobian[1], middle)])


def problem(n: int, n_steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Dense Jacobians without structure, so that rows must be exchanged in the factors."""
    rng = np.random.default_rng(n)
    return (
        rng.uniform(0.1, 3.0, n_steps),
        rng.normal(size=(n_steps, 2, n, n)),
        rng.normal(size=(n_steps, 2, n)),
        rng.normal(size=n),
    )


def marched(step: np.ndarray, jacobian: np.ndarray, constant: np.ndarray, start: np.ndarray) -> np.ndarray:
    """March with every entry moving, about zero."""
    n_steps, _, n, _ = jacobian.shape
    row, column = (index.ravel() for index in np.indices((n, n)))
    moving = jacobian.reshape(n_steps, 2, n * n)
    return march(step, np.zeros((n, n)), row, column, moving, constant, np.zeros((n_steps, 2, n)), start, GAMMA)


def test_march_is_the_scheme() -> None:
    for n in (1, 2, 5):
        step, jacobian, constant, start = problem(n, 12)
        found = marched(step, jacobian, constant, start)
        state = start
        for k in range(step.size):
            stages = scheme(step[k], jacobian[k], constant[k], state)
            np.testing.assert_allclose(found[k], stages, rtol=1e-9, atol=1e-9 * np.abs(stages).max())
            state = stages[1]


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-3, 0.3, 30.0])
def test_march_about_any_states_with_a_few_moving_entries_is_the_scheme(size: float) -> None:
    """One inverse for many steps, renewed where the step or the entries change too much, gives what dense solves give."""
    rng = np.random.default_rng(3)
    n, n_steps = 6, 40
    step = np.repeat([20.0, 20.5, 60.0, 20.0], 10)
    fixed = -np.diag(rng.uniform(1e-4, 1e-1, n)) + rng.uniform(0.0, 1e-3, (n, n))
    row, column = np.array([0, 2, 2, 5]), np.array([0, 2, 3, 1])
    moving = -size * rng.uniform(0.0, 1e-2, (n_steps, 2, 4))
    about, rate = rng.normal(300.0, 10.0, (n_steps, 2, n)), rng.normal(0.0, 1e-2, (n_steps, 2, n))
    jacobian = np.broadcast_to(fixed, (n_steps, 2, n, n)).copy()
    for e in range(4):
        jacobian[:, :, row[e], column[e]] += moving[:, :, e]
    state = rng.normal(300.0, 10.0, n)
    found = march(step, fixed, row, column, moving, rate, about, state, GAMMA)
    for k in range(n_steps):
        constant = rate[k] - np.einsum("sij,sj->si", jacobian[k], about[k])
        stages = scheme(step[k], jacobian[k], constant, state)
        np.testing.assert_allclose(found[k], stages, rtol=0.0, atol=1e-8)
        state = stages[1]


def test_sensitivities_are_the_scheme_of_their_own_equation() -> None:
    """d/dp of the scheme is the scheme for J s + df/dp; samples may be the start, repeated steps or absent."""
    n, n_steps = 3, 10
    step, jacobian, _, _ = problem(n, n_steps)
    rng = np.random.default_rng(9)
    column, node = np.array([0, 1, 1]), np.array([2, 0, 2])
    series = rng.normal(size=(3, n_steps, 2))
    start = rng.normal(size=(n, 3))
    samples = np.array([0, 2, 3, 10])
    observed = np.array([2, 0])
    found, end = march_sensitivities(step, jacobian, column, node, series, start, samples, observed, GAMMA)
    for c in range(3):
        state, states = start[:, c], [start[:, c]]
        for k in range(n_steps):
            constant = np.zeros((2, n))
            for e in range(3):
                if column[e] == c:
                    constant[:, node[e]] += series[e, k]
            state = scheme(step[k], jacobian[k], constant, state)[1]
            states.append(state)
        np.testing.assert_allclose(found[:, :, c], np.array(states)[samples][:, observed], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(end[:, c], state, rtol=1e-9, atol=1e-9)


def test_the_scheme_is_stiffly_accurate_and_damps_at_infinity() -> None:
    """With f = -rate (x - target), rate h -> infinity, one step lands on the target."""
    rate, target = 1e12, 7.0
    found = marched(np.ones(1), np.full((1, 2, 1, 1), -rate), np.full((1, 2, 1), rate * target), np.array([300.0]))
    np.testing.assert_allclose(found[0, 1], target, atol=1e-8)
