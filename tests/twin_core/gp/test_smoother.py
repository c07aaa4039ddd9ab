"""The smoother against the dense joint Gaussian, and in degenerate models."""

import numpy as np
import pytest
from scipy.stats import chi2

from twin_core.errors import ModelError
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.smoother import smooth
from twin_core.gp.state_space import LinearModel


@pytest.mark.parametrize("missing", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_smoother_is_the_dense_posterior(dense, seed, missing):
    model = dense.random_model(seed)
    _, y = dense.draw(model, seed, missing)
    out = smooth(model, kalman_filter(model, y), keep_lag_one=True)
    mean, cov, _ = dense.condition(model, y)
    np.testing.assert_allclose(out.mean, mean, atol=1e-8)
    for k in range(model.n_times):
        np.testing.assert_allclose(out.cov[k], cov[k, :, k, :], atol=1e-8)
        np.testing.assert_allclose(out.variance[k], np.diag(cov[k, :, k, :]), atol=1e-8)
    for k in range(model.n_times - 1):
        np.testing.assert_allclose(out.lag_one_cov[k], cov[k + 1, :, k, :], atol=1e-8)


def test_settled_gains_change_nothing(dense):
    model = dense.random_model(1, n_times=500, distinct=False)
    _, y = dense.draw(model, 1)
    y[200:205, 0] = np.nan
    free = smooth(model, kalman_filter(model, y, settle_tolerance=-1.0), settle_tolerance=-1.0, keep_lag_one=True)
    settled = smooth(model, kalman_filter(model, y), keep_lag_one=True)
    for name in ("mean", "cov", "variance", "lag_one_cov"):
        np.testing.assert_allclose(getattr(settled, name), getattr(free, name), atol=1e-10)


def test_constants_and_repeated_states_need_no_inverse(dense):
    """Two states that are always equal and one without noise: the predicted covariance is singular throughout."""
    model = LinearModel.build(
        transition=np.diag([0.9, 0.9, 1.0]),
        process_cov=np.array([[0.1, 0.1, 0.0], [0.1, 0.1, 0.0], [0.0, 0.0, 0.0]]),
        observation=np.array([[1.0, 0.0, 1.0]]),
        noise_variance=np.array([0.2]),
        prior_mean=np.zeros(3),
        prior_cov=np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 2.0]]),
        n_times=15,
    )
    y = np.sin(np.arange(15.0))
    out = smooth(model, kalman_filter(model, y))
    mean, cov, _ = dense.condition(model, y[:, None])
    np.testing.assert_allclose(out.mean, mean, atol=1e-8)
    np.testing.assert_allclose(out.variance, np.einsum("kiki->ki", cov), atol=1e-8)


def test_covariances_may_be_left_out(dense):
    model = dense.random_model(0)
    _, y = dense.draw(model, 0)
    filtered = kalman_filter(model, y)
    short, full = smooth(model, filtered, keep_cov=False), smooth(model, filtered)
    assert short.cov.shape[0] == 0 and short.lag_one_cov.shape[0] == 0
    np.testing.assert_array_equal(short.variance, full.variance)


def test_smoother_needs_filtered_states(dense):
    model = dense.random_model(0)
    _, y = dense.draw(model, 0)
    with pytest.raises(ModelError, match="keep='states'"):
        smooth(model, kalman_filter(model, y, keep="innovations"))


@pytest.mark.statistical
def test_nees_is_chi_square_over_seeds(dense):
    """(x - m)ᵀ P⁻¹ (x - m) at mid record, 3 states, 400 runs: chi-square with 1200 degrees; two-sided 1e-4."""
    total = 0.0
    for seed in range(400):
        model = dense.random_model(seed % 5, n_times=21, distinct=False)
        x, y = dense.draw(model, 1000 + seed)
        out = smooth(model, kalman_filter(model, y))
        away = x[10] - out.mean[10]
        total += float(away @ np.linalg.solve(out.cov[10], away))
    assert chi2.ppf(5e-5, 1200) < total < chi2.ppf(1 - 5e-5, 1200)
