"""The compiled filter against the joint Gaussian of all readings, written down densely."""

import numpy as np
import pytest

from twin_core.latent_force.held import intervals
from twin_core.latent_force.whitening import affine_march, whiten_columns

N, N_STEPS, N_COLUMNS = 3, 14, 4


def system(seed: int) -> dict[str, np.ndarray]:
    """Return a random stable system, some of whose grid points carry no sample and some samples no reading."""
    rng = np.random.default_rng(seed)
    sample_of = np.full(N_STEPS + 1, -1, dtype=np.int64)
    sampled = np.sort(rng.choice(N_STEPS + 1, 9, replace=False))
    sample_of[sampled] = np.arange(9)
    return {
        "transition": 0.9 * np.eye(N) + 0.05 * rng.normal(size=(N_STEPS, N, N)),
        "response": 0.3 * np.eye(N) + 0.05 * rng.normal(size=(N_STEPS, N, N)),
        "keep": rng.uniform(0.2, 0.95, N_STEPS),
        "kind": np.arange(N_STEPS),
        "interval": np.full(N_STEPS, -1),
        "force_variance": rng.uniform(0.1, 4.0, N),
        "state_variance": rng.uniform(1e-4, 1e-2, N),
        "observed": np.array([2, 0], dtype=np.int64),
        "noise_variance": np.array([0.04, 0.3]),
        "start_variance": np.array([4.0, 25.0, 1.0]),
        "sample_of": sample_of,
        "valid": rng.random((9, 2)) < 0.8,
        "columns": rng.normal(size=(9, 2, N_COLUMNS)),
    }


def dense_covariance(s: dict[str, np.ndarray]) -> np.ndarray:
    """Return the covariance of all valid readings, by writing every state as a sum over independent sources.

    The sources are the start (n), the heat at the start (n), and per step a state and a heat increment (2 n).
    """
    n_sources = 2 * N * (N_STEPS + 1)
    scale = np.zeros(n_sources)
    scale[: 2 * N] = np.concatenate([s["start_variance"], s["force_variance"]])
    state = np.zeros((2 * N, n_sources))
    state[:, : 2 * N] = np.eye(2 * N)
    rows = []
    for k in range(N_STEPS + 1):
        if k:
            full = np.zeros((2 * N, 2 * N))
            full[:N, :N], full[:N, N:] = s["transition"][k - 1], s["response"][k - 1]
            full[N:, N:] = s["keep"][k - 1] * np.eye(N)
            state = full @ state
            own = slice(2 * N * k, 2 * N * (k + 1))
            state[:, own] = np.eye(2 * N)
            heat = s["force_variance"] * (1.0 - s["keep"][k - 1] ** 2)
            scale[own] = np.concatenate([s["state_variance"], heat])
        if s["sample_of"][k] >= 0:
            rows += [state[o] for i, o in enumerate(s["observed"]) if s["valid"][s["sample_of"][k], i]]
    design = np.array(rows)
    noise = np.concatenate([s["noise_variance"][row] for row in s["valid"]])
    return design @ np.diag(scale) @ design.T + np.diag(noise)


@pytest.mark.parametrize("seed", range(4))
def test_whitening_is_the_joint_gaussian(seed: int) -> None:
    """Inner products of whitened columns are those of the inverse covariance, and so is the determinant."""
    s = system(seed)
    whitened, log_det = whiten_columns(**s)
    covariance = dense_covariance(s)
    columns = s["columns"][s["valid"]]
    expected = columns.T @ np.linalg.solve(covariance, columns)
    flat = whitened.reshape(-1, N_COLUMNS)
    np.testing.assert_allclose(flat.T @ flat, expected, rtol=1e-8)
    assert log_det == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-8)


def test_readings_that_are_missing_leave_no_trace() -> None:
    s = system(1)
    whitened, log_det = whiten_columns(**s)
    np.testing.assert_array_equal(whitened[~s["valid"]], 0.0)
    poisoned = {**s, "columns": np.where(s["valid"][:, :, None], s["columns"], 1e9)}
    again, same = whiten_columns(**poisoned)
    np.testing.assert_array_equal(again, whitened)
    assert same == log_det


def test_columns_do_not_see_each_other() -> None:
    s = system(2)
    together, _ = whiten_columns(**s)
    for c in range(N_COLUMNS):
        alone, _ = whiten_columns(**{**s, "columns": np.ascontiguousarray(s["columns"][:, :, c : c + 1])})
        np.testing.assert_allclose(alone[:, :, 0], together[:, :, c], rtol=1e-10, atol=1e-12)


def test_without_undeclared_heat_only_the_start_and_noise_are_left() -> None:
    """A still system known but for its start: the mean of m readings has variance P0 + R / m."""
    n_times = 6
    s = {
        "transition": np.tile(np.eye(1), (n_times - 1, 1, 1)),
        "response": np.zeros((n_times - 1, 1, 1)),
        "keep": np.full(n_times - 1, 0.5),
        "kind": np.arange(n_times - 1),
        "interval": np.full(n_times - 1, -1),
        "force_variance": np.zeros(1),
        "state_variance": np.zeros(1),
        "observed": np.zeros(1, dtype=np.int64),
        "noise_variance": np.array([0.09]),
        "start_variance": np.array([4.0]),
        "sample_of": np.arange(n_times),
        "valid": np.ones((n_times, 1), dtype=np.bool_),
        "columns": np.ones((n_times, 1, 1)),
    }
    whitened, _ = whiten_columns(**s)
    # 1' (R I + P0 11')^-1 1 = m / (R + m P0)
    assert float((whitened**2).sum()) == pytest.approx(n_times / (0.09 + n_times * 4.0))


def test_affine_march_is_the_recursion() -> None:
    rng = np.random.default_rng(0)
    transition, offset, start = rng.normal(size=(5, N, N)), rng.normal(size=(5, N)), rng.normal(size=N)
    found = affine_march(transition, offset, start)
    expected = [start]
    for k in range(5):
        expected.append(transition[k] @ expected[-1] + offset[k])
    np.testing.assert_allclose(found, np.array(expected), rtol=1e-12, atol=1e-12)


def alike(n_steps: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return a system whose steps are alike, sampled at every other step, with one stretch in which a sensor is silent."""
    rng = np.random.default_rng(seed)
    n_rows = n_steps // 2 + 1
    sample_of = np.full(n_steps + 1, -1, dtype=np.int64)
    sample_of[::2] = np.arange(n_rows)
    valid = np.ones((n_rows, 2), dtype=np.bool_)
    valid[n_rows // 3 : n_rows // 2, 1] = False
    kind = np.zeros(n_steps, dtype=np.int64)
    return {
        **system(seed),
        "transition": 0.9 * np.eye(N)[None] + 0.03 * rng.normal(size=(1, N, N)),
        "response": 0.3 * np.eye(N)[None],
        "keep": np.array([0.8]),
        "kind": kind,
        "sample_of": sample_of,
        "interval": intervals(kind, sample_of, valid),
        "valid": valid,
        "columns": rng.normal(size=(n_rows, 2, N_COLUMNS)),
    }


def test_a_filter_that_has_settled_is_the_filter_that_never_does() -> None:
    s = alike(2400)
    never = whiten_columns(**{**s, "interval": np.full(s["kind"].size, -1)})
    found = whiten_columns(**s)
    np.testing.assert_allclose(found[0], never[0], rtol=1e-5, atol=1e-6)
    assert found[1] == pytest.approx(never[1], rel=1e-7)


def test_intervals_are_alike_where_steps_and_sensors_are() -> None:
    kind = np.array([0, 0, 1, 1, 0, 1, 0, 0, 0])
    sample_of = np.array([0, -1, 1, -1, 2, -1, 3, -1, 4, -1])
    valid = np.array([[True], [True], [True], [True], [True]])
    found = intervals(kind, sample_of, valid)
    assert found[0] == found[1] == found[6] == found[7] >= 0  # two steps of kind 0
    assert found[2] == found[3] >= 0 and found[2] != found[0]
    assert found[4] == found[5] == -1  # one of each kind
    assert found[8] == -1  # no sample follows
    valid[4] = False
    found = intervals(kind, sample_of, valid)
    assert found[6] != found[0]
