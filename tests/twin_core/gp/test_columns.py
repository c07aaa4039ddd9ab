"""The white regression against generalised least squares with the dense covariance of all samples."""

import numpy as np
import pytest

from twin_core.errors import ModelError
from twin_core.gp.columns import whiten_responses
from twin_core.gp.kalman import kalman_filter


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_normal_equations_are_the_dense_ones(dense, missing):
    model = dense.random_model(2, n_times=15)
    _, y = dense.draw(model, 2, missing)
    offsets = np.random.default_rng(3).normal(size=(4, 14, 3))
    found = whiten_responses(model, y, offsets)
    mean, cov = dense.joint(model)
    size = model.n_times * model.n_states
    h = np.kron(np.eye(model.n_times), model.observation)
    seen = np.isfinite(y).ravel()
    spread = h @ cov.reshape(size, size) @ h.T + np.diag(np.tile(model.noise_variance, model.n_times))
    inverse = np.linalg.inv(spread[np.ix_(seen, seen)])
    responses = []
    for column in offsets:
        x = np.zeros((model.n_times, 3))
        for k in range(model.n_times - 1):
            x[k + 1] = model.transition[model.step_index[k]] @ x[k] + column[k]
        responses.append((x @ model.observation.T).ravel()[seen])
    z, r = np.array(responses).T, y.ravel()[seen] - (h @ mean.ravel())[seen]
    np.testing.assert_allclose(found.columns.T @ found.columns, z.T @ inverse @ z, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(found.columns.T @ found.target, z.T @ inverse @ r, rtol=1e-8, atol=1e-9)
    assert found.target @ found.target == pytest.approx(r @ inverse @ r, rel=1e-9)
    assert found.log_likelihood == pytest.approx(kalman_filter(model, y).log_likelihood, abs=1e-9)


def test_settled_gains_change_nothing(dense):
    model = dense.random_model(4, n_times=300, distinct=False)
    _, y = dense.draw(model, 4)
    offsets = np.random.default_rng(3).normal(size=(2, 299, 3))
    free, settled = (whiten_responses(model, y, offsets, settle_tolerance=t) for t in (-1.0, 1e-13))
    np.testing.assert_allclose(settled.columns, free.columns, atol=1e-9)


def test_shapes_are_checked(dense):
    model = dense.random_model(0)
    with pytest.raises(ModelError, match="offsets have shape"):
        whiten_responses(model, np.zeros((12, 2)), np.zeros((2, 12, 3)))
