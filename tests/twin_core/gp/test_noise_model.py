"""Whitening against a dense Cholesky factor; fits against simulated and degenerate noise."""

import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from twin_core.errors import ModelError
from twin_core.gp.noise_model import ResidualNoise, _climb, _score, fit


def _covariance(times: np.ndarray, noise: ResidualNoise) -> np.ndarray:
    lags = np.abs(np.subtract.outer(times, times))
    return noise.sigma_ou**2 * np.exp(-lags / noise.length_s) + noise.sigma_white**2 * np.eye(times.size)


def _simulate(seed: int, times: np.ndarray, noise: ResidualNoise) -> np.ndarray:
    rng = np.random.default_rng(seed)
    decay = np.exp(-np.diff(times) / noise.length_s)
    coloured = np.empty(times.size)
    coloured[0] = noise.sigma_ou * rng.normal()
    for k, d in enumerate(decay):
        coloured[k + 1] = d * coloured[k] + noise.sigma_ou * np.sqrt(1 - d * d) * rng.normal()
    return coloured + noise.sigma_white * rng.normal(size=times.size)


CASES = [
    ResidualNoise(1.0, 8.0, 0.3, 0.0),
    ResidualNoise(2.0, 500.0, 0.01, 0.0),
    ResidualNoise(0.0, 1.0, 0.7, 0.0),
    ResidualNoise(1.0, 0.1, 1e-6, 0.0),
]


@pytest.mark.parametrize("noise", CASES)
def test_whitening_is_the_dense_cholesky_factor(noise):
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.2, 3.0, 60))
    valid = rng.random(60) > 0.3
    columns = rng.normal(size=(60, 4))
    white, log_det = noise.whiten(times, np.where(valid[:, None], columns, np.nan), valid)
    lower = np.linalg.cholesky(_covariance(times[valid], noise))
    np.testing.assert_allclose(white[valid], solve_triangular(lower, columns[valid], lower=True), atol=1e-9, rtol=1e-9)
    assert log_det == pytest.approx(2 * np.log(np.diag(lower)).sum(), abs=1e-9)
    assert (white[~valid] == 0).all()


def test_likelihood_and_gradient():
    rng = np.random.default_rng(2)
    times = np.cumsum(rng.uniform(0.2, 3.0, 40))
    residual = rng.normal(size=40)
    point = np.log([0.8, 5.0, 0.4])
    total, gradient, _ = _score(np.diff(times), residual, point)
    cov = _covariance(times, ResidualNoise(0.8, 5.0, 0.4, 0.0))
    assert total == pytest.approx(multivariate_normal(np.zeros(40), cov).logpdf(residual), abs=1e-9)
    for p in range(3):
        step = np.zeros(3)
        step[p] = 1e-5
        ahead, back = (
            _score(np.diff(times), residual, point + step)[0],
            _score(np.diff(times), residual, point - step)[0],
        )
        assert gradient[p] == pytest.approx((ahead - back) / 2e-5, abs=1e-6)


def test_information_is_fishers_on_average() -> None:
    """Against half the trace of (C^-1 dC)^2 by central differences of the dense covariance, over many series."""
    truth, times = ResidualNoise(0.8, 5.0, 0.4, 0.0), np.cumsum(np.random.default_rng(5).uniform(0.2, 3.0, 40))
    point, step = np.log([0.8, 5.0, 0.4]), 1e-5
    slopes = []
    for p in range(3):
        ahead, back = (_covariance(times, ResidualNoise(*np.exp(point + s * np.eye(3)[p]), 0.0)) for s in (step, -step))
        slopes.append(np.linalg.solve(_covariance(times, truth), (ahead - back) / (2.0 * step)))
    expected = np.array([[0.5 * np.trace(a @ b) for b in slopes] for a in slopes])
    drawn = [_score(np.diff(times), _simulate(seed, times, truth), point)[2] for seed in range(2000)]
    np.testing.assert_allclose(np.mean(drawn, axis=0), expected, rtol=0.03, atol=0.03)


def test_climbs_end_as_high_as_scipys() -> None:
    """L-BFGS-B from the same start between the same bounds. Either may be caught; ours not more often."""
    rng, gains = np.random.default_rng(6), []
    times = np.arange(300.0)
    for seed in range(200):
        truth = ResidualNoise(1.0, 10.0 ** rng.uniform(-1.0, 4.0), 10.0 ** rng.uniform(-2.5, 0.5), 0.0)
        residual, floor = _simulate(seed, times, truth), rng.choice([1e-3, 0.1])
        spread, steps = max(float(np.sqrt(np.mean(residual**2))), floor), np.diff(times)
        low, high = np.log([(1e-3 * floor, 30.0 * spread), (0.2, 10.0 * 299.0), (floor, 2.0 * spread)]).T
        start = np.clip(np.log([0.6, 2.0 * truth.length_s, 1.5 * truth.sigma_white]), low, high)

        def negative(
            values: np.ndarray, steps: np.ndarray = steps, own: np.ndarray = residual
        ) -> tuple[float, np.ndarray]:
            total, gradient, _ = _score(steps, own, values)
            return -total, -gradient

        peer = minimize(negative, start, jac=True, method="L-BFGS-B", bounds=list(zip(low, high, strict=True)))
        total, point = _climb(steps, residual, start, low, high)
        assert (low <= point).all() and (point <= high).all()
        gains.append(total + float(peer.fun))
    assert np.mean(np.abs(gains) < 0.01) > 0.9
    assert np.sum(np.array(gains) < -0.01) <= np.sum(np.array(gains) > 0.01)


@pytest.mark.parametrize("irregular", [False, True])
def test_fit_recovers_the_noise(irregular):
    """The fit must beat the truth in likelihood and come near it; 2000 samples tell sigma_ou to about 20 %."""
    truth = ResidualNoise(0.5, 30.0, 0.1, 0.0)
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.2, 3.0, 2000)) if irregular else np.arange(2000.0)
    residual = _simulate(3, times, truth)
    residual[500:600] = np.nan
    found = fit(times, residual, white_floor=1e-3)
    seen = np.isfinite(residual)
    at_truth = _score(np.diff(times[seen]), residual[seen], np.log([0.5, 30.0, 0.1]))[0]
    assert found.log_likelihood >= at_truth
    assert found.sigma_ou == pytest.approx(0.5, rel=0.5)
    assert found.length_s == pytest.approx(30.0, rel=0.8)
    assert found.sigma_white == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("white", [False, True])
def test_a_climb_from_noise_nearby_ends_where_one_from_everywhere_does(white: bool) -> None:
    """White noise is no place to climb from: all starts are tried then."""
    rng, time_s = np.random.default_rng(11), 60.0 * np.arange(600)
    covariance = 0.3**2 * np.exp(-np.abs(time_s[:, None] - time_s) / 900.0) + 0.05**2 * np.eye(600)
    residual = rng.multivariate_normal(np.zeros(600), covariance)
    near = ResidualNoise(0.0 if white else 0.2, 600.0, 0.07, 0.0)
    found, best = (fit(time_s, residual, white_floor=0.01, near=start) for start in (near, None))
    assert found.log_likelihood == pytest.approx(best.log_likelihood, abs=1e-3)
    assert found.length_s == pytest.approx(best.length_s, rel=0.01)


def test_white_noise_stays_white():
    residual = np.random.default_rng(4).normal(size=2000)
    found = fit(np.arange(2000.0), residual, white_floor=1e-3)
    assert found.sigma_ou == 0.0
    assert found.sigma_white == pytest.approx(np.sqrt(np.mean(residual**2)))


def test_floor_holds():
    found = fit(np.arange(300.0), np.sin(np.arange(300.0) / 40), white_floor=0.05)
    assert found.sigma_white == pytest.approx(0.05, rel=1e-6) and found.sigma_ou > 0.3
    still = fit(np.arange(300.0), np.zeros(300), white_floor=0.05)
    assert (still.sigma_ou, still.sigma_white) == (0.0, 0.05)


def test_one_sample():
    found = fit(np.array([3.0]), np.array([2.0]), white_floor=0.1)
    assert (found.sigma_ou, found.sigma_white) == (0.0, 2.0)
    assert found.log_likelihood == pytest.approx(multivariate_normal(0, 4.0).logpdf(2.0))


@pytest.mark.parametrize(
    ("times", "residual", "floor", "words"),
    [
        ([0.0, 1.0], [1.0, 2.0], 0.0, "white_floor must be positive"),
        ([0.0, 0.0], [1.0, 2.0], 0.1, "strictly increasing"),
        ([0.0, np.nan], [1.0, 2.0], 0.1, "strictly increasing"),
        ([0.0, 1.0], [np.nan, np.nan], 0.1, "no finite sample"),
        ([0.0, 1.0, 2.0], [1.0, 2.0], 0.1, "rows must agree"),
    ],
)
def test_bad_input_is_told(times, residual, floor, words):
    with pytest.raises(ModelError, match=words):
        fit(np.array(times), np.array(residual), white_floor=floor)


def test_whitening_refuses_what_it_cannot_use():
    ones, valid = np.ones((2, 1)), np.ones(2, dtype=bool)
    with pytest.raises(ModelError, match="no variance"):
        ResidualNoise(0.0, 1.0, 0.0, 0.0).whiten(np.arange(2.0), ones, valid)
    with pytest.raises(ModelError, match="valid sample is not finite"):
        ResidualNoise(0.0, 1.0, 1.0, 0.0).whiten(np.arange(2.0), ones * np.nan, valid)


@pytest.mark.parametrize("interval_s", [1.0, 60.0, 1e5])
def test_what_the_coloured_part_one_interval_earlier_does_not_tell(interval_s):
    """The conditional variance of two jointly normal variables: coloured part at t, residual at t + interval."""
    noise = ResidualNoise(0.3, 90.0, 0.1, 0.0)
    shared = noise.sigma_ou**2 * np.exp(-interval_s / noise.length_s)
    conditional = noise.sigma_ou**2 + noise.sigma_white**2 - shared**2 / noise.sigma_ou**2
    assert noise.unforeseen(interval_s) ** 2 == pytest.approx(conditional)


@pytest.mark.parametrize(("length_s", "n", "tolerance"), [(90.0, 4000, 1e-2), (1e-3, 4000, 1e-9), (1e9, 300, 1e-4)])
def test_what_lasts_is_the_variance_of_a_mean_times_their_number(length_s: float, n: int, tolerance: float) -> None:
    """Of many samples, of independent ones, and of a coloured part that never changes."""
    noise = ResidualNoise(0.3, length_s, 0.1, 0.0)
    of_the_mean = _covariance(60.0 * np.arange(n), noise).mean()
    assert noise.lasting(60.0, n) ** 2 == pytest.approx(n * of_the_mean, rel=tolerance)
