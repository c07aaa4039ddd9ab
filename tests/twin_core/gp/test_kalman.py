"""The filter against the dense joint Gaussian, and where the input is degenerate."""

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from twin_core.errors import ModelError
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.state_space import LinearModel


def _scalar(n_times: int, **changes) -> LinearModel:
    parts = dict(
        transition=np.array([[0.9]]),
        process_cov=np.array([[0.19]]),
        observation=np.array([[1.0]]),
        noise_variance=np.array([0.5]),
        prior_mean=np.zeros(1),
        prior_cov=np.eye(1),
        n_times=n_times,
    )
    return LinearModel.build(**{**parts, **changes})


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("seed", range(4))
def test_filter_is_the_dense_posterior(dense, seed, missing):
    model = dense.random_model(seed)
    _, y = dense.draw(model, seed, missing)
    out = kalman_filter(model, y, keep="all")
    for k in range(model.n_times):
        known = y.copy()
        known[k + 1 :] = np.nan
        mean, cov, _ = dense.condition(model, known)
        np.testing.assert_allclose(out.mean[k], mean[k], atol=1e-8)
        np.testing.assert_allclose(out.cov[k], cov[k, :, k, :], atol=1e-8)
        known[k] = np.nan
        mean, cov, _ = dense.condition(model, known)
        np.testing.assert_allclose(out.predicted_mean[k], mean[k], atol=1e-8)
        np.testing.assert_allclose(out.predicted_cov[k], cov[k, :, k, :], atol=1e-8)
    _, _, total = dense.condition(model, y)
    assert out.log_likelihood == pytest.approx(total, abs=1e-8)


def test_innovations_are_those_of_the_whole_row(dense):
    """Sensors are used one by one, but innovation, deviation and NIS are told of the row as one vector."""
    model = dense.random_model(3, m=3)
    _, y = dense.draw(model, 3, 0.3)
    out = kalman_filter(model, y, keep="all")
    for k in range(model.n_times):
        seen = np.isfinite(y[k])
        h = model.observation
        spread = h @ out.predicted_cov[k] @ h.T + np.diag(model.noise_variance)
        surprise = y[k] - h @ out.predicted_mean[k]
        np.testing.assert_allclose(out.innovation[k], surprise, atol=1e-12)
        np.testing.assert_allclose(out.innovation_std[k], np.sqrt(np.diag(spread)), atol=1e-12)
        assert out.n_seen[k] == seen.sum()
        if seen.any():
            nu, s = surprise[seen], spread[np.ix_(seen, seen)]
            assert out.nis[k] == pytest.approx(nu @ np.linalg.solve(s, nu), rel=1e-9)
        else:
            assert np.isnan(out.nis[k])


def test_settled_gains_change_nothing(dense):
    model = dense.random_model(4, n_times=400, distinct=False)
    _, y = dense.draw(model, 1)
    y[200:205] = np.nan
    free, settled = kalman_filter(model, y, settle_tolerance=-1.0), kalman_filter(model, y)
    assert free.settled.sum() == 0 and settled.settled.sum() > 200 and not settled.settled[200:206].any()
    assert settled.log_likelihood == pytest.approx(free.log_likelihood, rel=1e-12)
    np.testing.assert_allclose(settled.mean, free.mean, atol=1e-11)
    np.testing.assert_allclose(settled.cov, free.cov, atol=1e-11)
    np.testing.assert_allclose(settled.innovation_std, free.innovation_std, atol=1e-11)


def test_keep_levels_agree(dense):
    model = dense.random_model(2)
    _, y = dense.draw(model, 2)
    runs = {keep: kalman_filter(model, y, keep=keep) for keep in ("likelihood", "innovations", "states", "all")}
    assert len({run.log_likelihood for run in runs.values()}) == 1
    assert runs["likelihood"].nis.size == 0 and runs["innovations"].mean.shape[0] == 0
    assert runs["states"].predicted_mean.shape[0] == 0


def test_ornstein_uhlenbeck_is_analytic():
    """Dense covariance sigma² exp(-|t - t'| / l) plus white noise, no state space involved."""
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.5, 2.0, 40))
    decay = np.exp(-np.diff(times) / 7.0)
    model = _scalar(
        40, transition=decay[:, None, None], process_cov=(4.0 * (1 - decay**2))[:, None, None], prior_cov=[[4.0]]
    )
    cov = 4.0 * np.exp(-np.abs(np.subtract.outer(times, times)) / 7.0) + 0.5 * np.eye(40)
    y = rng.multivariate_normal(np.zeros(40), cov)
    out = kalman_filter(model, y)
    assert out.log_likelihood == pytest.approx(multivariate_normal(np.zeros(40), cov).logpdf(y), abs=1e-9)


def test_vague_prior_and_small_noise_stay_positive():
    """A prior of 1e6 K² seen through 1e-6 K noise: the filtered variance is the noise, to rounding."""
    model = LinearModel.build(
        transition=np.array([[1.0, 1.0], [0.0, 1.0]]),
        process_cov=np.zeros((2, 2)),
        observation=np.array([[1.0, 0.0]]),
        noise_variance=np.array([1e-12]),
        prior_mean=np.zeros(2),
        prior_cov=1e6 * np.eye(2),
        n_times=50,
    )
    out = kalman_filter(model, np.arange(50.0))
    values = np.linalg.eigvalsh(out.cov)
    assert (values[:, 0] > -1e-14 * values[:, 1]).all() and (np.einsum("kii->ki", out.cov) > 0).all()
    # Straight line through 50 samples of variance s: var of the last point is s (4 n - 2) / (n (n + 1)).
    assert out.cov[-1, 0, 0] == pytest.approx(1e-12 * 198 / (50 * 51), rel=1e-3)


def test_one_sample_and_nothing_seen():
    one = kalman_filter(_scalar(1), np.array([0.7]))
    assert one.mean[0, 0] == pytest.approx(0.7 / 1.5)
    blank = kalman_filter(_scalar(5), np.full(5, np.nan))
    assert blank.log_likelihood == 0.0 and np.isnan(blank.nis).all()
    np.testing.assert_allclose(blank.cov[:, 0, 0], 1.0)


def test_without_noise_the_sample_is_the_state():
    out = kalman_filter(_scalar(3, noise_variance=[0.0]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(out.mean[:, 0], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"prior_cov": [[np.inf]]}, "prior_cov: holds a number that is not finite"),
        ({"noise_variance": [-1.0]}, "noise_variance: must be at least 0, one is -1"),
        ({"noise_variance": [1.0, 1.0]}, "2 values for 1 sensors"),
        ({"transition": np.eye(2)}, "transition has shape"),
        ({"transition": np.ones((3, 1, 1))}, "step_index must say"),
        ({"step_index": [0, 0, 1, 0]}, "between 0 and 0"),
        ({"step_index": [0]}, "step_index has shape"),
        ({"process_cov": np.ones((2, 1, 1))}, "differ in shape"),
        ({"n_times": 0}, "at least one sample"),
        ({"n_times": 2.5}, "at least one sample, not 2.5"),
        ({"observation": [[1.0, 2.0]]}, "must have 1 columns"),
        ({"observation": np.ones((1, 1, 1))}, "must have 1 columns"),
        ({"offset": np.zeros((3, 1))}, r"offset: has shape \(3, 1\), it must have \(4, 1\)"),
        ({"prior_mean": ["warm"]}, "prior_mean: must be numbers"),
        ({"prior_mean": [[0.0]]}, r"prior_mean: has shape \(1, 1\)"),
        ({"process_cov": -np.eye(1)}, "process_cov: a variance is negative"),
    ],
)
def test_a_wrong_model_is_told(changes, words):
    with pytest.raises(ModelError, match=words):
        _scalar(**{"n_times": 5, **changes})


@pytest.mark.parametrize(
    ("cov", "words"),
    [([[1.0, 0.5], [-0.5, 1.0]], "prior_cov: must be symmetric"), ([[1.0, 5.0], [5.0, 1.0]], "is no covariance")],
)
def test_what_is_no_covariance_is_told(cov, words):
    with pytest.raises(ModelError, match=words):
        LinearModel.build(
            transition=np.eye(2),
            process_cov=np.eye(2),
            observation=np.eye(2),
            noise_variance=np.ones(2),
            prior_mean=np.zeros(2),
            prior_cov=np.array(cov),
            n_times=3,
        )


def test_a_tolerance_that_is_no_number_never_settles():
    y = np.arange(50.0)
    never, nan = (kalman_filter(_scalar(50), y, settle_tolerance=t) for t in (-1.0, np.nan))
    np.testing.assert_array_equal(nan.mean, never.mean)
    assert not nan.settled.any()


def test_an_unknown_wish_is_told():
    with pytest.raises(ModelError, match="keep: must be one of likelihood, innovations, states, all"):
        kalman_filter(_scalar(3), np.zeros(3), keep="everything")


def test_wrong_observations_are_told():
    with pytest.raises(ModelError, match="observations have shape"):
        kalman_filter(_scalar(5), np.zeros(4))
    with pytest.raises(ModelError, match="row 2, sensor 0 is infinite"):
        kalman_filter(_scalar(3), np.array([0.0, 1.0, np.inf]))
    exact = {"process_cov": [[0.0]], "noise_variance": [0.0], "prior_cov": [[0.0]]}
    with pytest.raises(ModelError, match="sample 0: a sensor without noise"):
        kalman_filter(_scalar(3, **exact), np.array([0.0, 1.0, 2.0]))


@pytest.mark.statistical
def test_nis_is_chi_square_over_seeds(dense):
    """Sum of NIS over 50 runs of 60 samples of 2 sensors: chi-square with 6000 degrees; two-sided 1e-4."""
    total = 0.0
    for seed in range(50):
        model = dense.random_model(seed % 5, n_times=60, distinct=False)
        _, y = dense.draw(model, 100 + seed)
        total += float(kalman_filter(model, y, keep="innovations").nis.sum())
    assert chi2.ppf(5e-5, 6000) < total < chi2.ppf(1 - 5e-5, 6000)
