"""Restricted likelihood: that of error contrasts, in any unit, blind to what unknowns follow, averaged or not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from twin_core.calibrate import restricted
from twin_core.calibrate.restricted import (
    ExpectedNoise,
    Leftover,
    expected_noise,
    no_longer,
    restricted_log_likelihood,
)
from twin_core.gp.noise_model import ResidualNoise, fit

NOISE_K, STEP_S, SPAN_S = 0.1, 60.0, 36e3


def dense(model: ResidualNoise, time_s: np.ndarray) -> np.ndarray:
    """Return the covariance of a noise, (n_times, n_times)."""
    lags = np.abs(time_s[:, None] - time_s)
    return model.sigma_ou**2 * np.exp(-lags / model.length_s) + model.sigma_white**2 * np.eye(time_s.size)


def design(time_s: np.ndarray, n_unknowns: int, rng: np.random.Generator) -> np.ndarray:
    """Return slow responses, (n_times, n_unknowns), as those of temperatures to parameters are."""
    u = np.linspace(0.0, np.pi, time_s.size)
    return np.cos(np.arange(n_unknowns) * u[:, None]) + 0.2 * rng.normal(size=n_unknowns)


def noise(sigma_ou: float, length_s: float, sigma_white: float = NOISE_K) -> ResidualNoise:
    return ResidualNoise(sigma_ou, length_s, sigma_white, 0.0)


def no_prior(n_unknowns: int) -> np.ndarray:
    return np.zeros((n_unknowns + 1, n_unknowns + 1))


def value(left: list[Leftover], models: list[ResidualNoise]) -> float:
    parts = [part.weigh(model) for part, model in zip(left, models, strict=True)]
    products = sum(p for _, p in parts)
    return restricted_log_likelihood(sum(d for d, _ in parts), products)


def test_it_is_the_likelihood_of_what_no_unknown_can_follow() -> None:
    """Oracle: the ordinary likelihood of two sensors' readings projected on the null space of the unknowns' responses."""
    rng = np.random.default_rng(0)
    times = [np.cumsum(rng.uniform(30.0, 90.0, n)) for n in (40, 30)]
    responses = [design(t, 6, rng) for t in times]
    read = [rng.normal(0.0, 0.3, t.size) for t in times]
    left = [Leftover(t, np.column_stack([j, r])) for t, j, r in zip(times, responses, read, strict=True)]
    contrasts = null_space(np.concatenate(responses).T)

    def oracle(models: list[ResidualNoise]) -> float:
        full = np.zeros((70, 70))
        full[:40, :40], full[40:, 40:] = (dense(m, t) for m, t in zip(models, times, strict=True))
        spread = contrasts.T @ full @ contrasts
        return float(multivariate_normal.logpdf(contrasts.T @ np.concatenate(read), cov=spread))

    tried = [[noise(0.2, 300.0), noise(0.0, 60.0)], [noise(0.5, 5e3, 0.2), noise(0.1, 1e4)], [noise(1.0, 1e6)] * 2]
    for models in tried[1:]:
        assert value(left, models) - value(left, tried[0]) == pytest.approx(oracle(models) - oracle(tried[0]), rel=1e-6)


def test_the_average_of_a_misfit_keeps_its_share_of_the_variance() -> None:
    """Oracle: the mean of the covariance over the readings of a row."""
    time_s = STEP_S * np.arange(400)
    for length_s in (100.0, 1e3, 1e5):
        model = noise(0.3, length_s, 1e-9)
        exact = float(dense(model, time_s[:8]).mean())
        rows = time_s.reshape(-1, 8).mean(axis=1)
        log_det, products = Leftover(rows, np.eye(50), 8).weigh(model)
        assert float(np.linalg.inv(products)[0, 0]) == pytest.approx(exact, rel=0.1), length_s
        assert np.isfinite(log_det)


def fitted(
    rng: np.random.Generator, misfit: ResidualNoise, n_sensors: int = 6, n_own: int = 5
) -> tuple[list[Leftover], list[ResidualNoise]]:
    """Return what least squares leaves of a misfit at every sensor, and the noise that it looks like.

    Each sensor has responses of its own, as capacities and initial temperatures do, and all share three.
    """
    time_s = STEP_S * np.arange(600)
    blocks = [np.zeros((600, n_own * n_sensors + 3)) for _ in range(n_sensors)]
    for k, block in enumerate(blocks):
        block[:, n_own * k : n_own * (k + 1)] = design(time_s, n_own, rng)
        block[:, -3:] = design(time_s, 3, rng) * rng.normal(size=3)
    root = np.linalg.cholesky(dense(misfit, time_s))
    drawn = np.concatenate([root @ rng.normal(size=600) for _ in range(n_sensors)])
    everything = np.concatenate(blocks)
    drawn -= everything @ np.linalg.lstsq(everything, drawn, rcond=None)[0]
    read = drawn.reshape(n_sensors, 600)
    left = [Leftover(time_s, np.column_stack([b, r])) for b, r in zip(blocks, read, strict=True)]
    return left, [fit(time_s, r, white_floor=0.7 * NOISE_K) for r in read]


def power_K2_s(found: ExpectedNoise | ResidualNoise, cycles: float = 1.0) -> float:
    """Return the spectral power of a misfit at so many cycles per record: there it bends slow responses."""
    turn = 2.0 * np.pi * cycles / SPAN_S
    parts = found.coloured if isinstance(found, ExpectedNoise) else ((found.sigma_ou**2, found.length_s),)
    return sum(2.0 * variance * length / (1.0 + (turn * length) ** 2) for variance, length in parts)


@pytest.mark.parametrize("n_groups", [6, 2])
def test_a_slow_misfit_that_the_unknowns_followed_is_seen(n_groups: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is left shows hardly any of it; its power where the unknowns are comes back within a factor two.

    So it does where sensors and unknowns are so many that sensors share a misfit.
    """
    monkeypatch.setattr(restricted, "MOST_PRODUCTS", n_groups * 13 * 34**2)
    truth = noise(0.1, 1.2e4)
    found, looked = [], []
    for seed in range(8):
        left, models = fitted(np.random.default_rng(seed), truth)
        found += [power_K2_s(m) / power_K2_s(truth) for m in expected_noise(left, no_prior(33), models, SPAN_S)]
        looked += [power_K2_s(m) / power_K2_s(truth) for m in models]
    assert np.mean(looked) < 0.1
    assert 0.5 < np.mean(found) < 2.0


def test_white_noise_stays_white() -> None:
    """Bands grow by the root of coloured over white power: by less than a quarter at a cycle per record."""
    white = NOISE_K**2 * STEP_S
    found = []
    for seed in range(8):
        left, models = fitted(np.random.default_rng(100 + seed), noise(0.0, 60.0), n_own=3)
        found += [power_K2_s(m) / white for m in expected_noise(left, no_prior(21), models, SPAN_S)]
    assert np.median(np.sqrt(1.0 + np.array(found))) < 1.25


def test_units_do_not_matter() -> None:
    """Temperatures in mK, times in minutes, unknowns in any unit: the same misfit."""
    left, models = fitted(np.random.default_rng(1), noise(0.1, 6e3))
    units = np.append(np.geomspace(1e-4, 1e4, 33), 1.0)
    other = [Leftover(p.time_s / 60.0, 1e3 * p.columns * units, p.together) for p in left]
    scaled = [ResidualNoise(1e3 * m.sigma_ou, m.length_s / 60.0, 1e3 * m.sigma_white, m.log_likelihood) for m in models]
    once = expected_noise(left, no_prior(33), models, SPAN_S)
    again = expected_noise(other, no_prior(33), scaled, SPAN_S / 60.0)
    for a, b in zip(once, again, strict=True):
        assert b.white_K2 == pytest.approx(1e6 * a.white_K2)
        assert 60.0 * power_K2_s_in_minutes(b) == pytest.approx(1e6 * power_K2_s(a), rel=1e-3)


def power_K2_s_in_minutes(found: ExpectedNoise) -> float:
    return power_K2_s(ExpectedNoise(found.white_K2, tuple((v, 60.0 * length) for v, length in found.coloured))) / 60.0


def test_an_unknown_that_nothing_tells_has_no_say() -> None:
    left, models = fitted(np.random.default_rng(2), noise(0.1, 6e3))
    more = [Leftover(p.time_s, np.insert(p.columns, 4, 0.0, axis=1)) for p in left]
    for a, b in zip(
        expected_noise(left, no_prior(33), models, SPAN_S),
        expected_noise(more, no_prior(34), models, SPAN_S),
        strict=True,
    ):
        assert power_K2_s(b) == pytest.approx(power_K2_s(a), rel=1e-6)


def test_averaged_readings_tell_the_same_misfit() -> None:
    left, models = fitted(np.random.default_rng(3), noise(0.1, 6e3))
    rows = np.arange(600).reshape(-1, 3)
    fewer = [Leftover(p.time_s[rows].mean(axis=1), p.columns[rows].mean(axis=1), 3) for p in left]
    once, again = (expected_noise(parts, no_prior(33), models, SPAN_S) for parts in (left, fewer))
    assert np.sum([power_K2_s(m) for m in again]) == pytest.approx(np.sum([power_K2_s(m) for m in once]), rel=0.15)


@pytest.mark.parametrize("smallness", [1e-3, 1e-8])
def test_a_misfit_out_of_all_proportion_to_the_noise_is_weighed(smallness: float) -> None:
    """A residual that is all colour, white noise next to none: the numbers stay finite and the misfit about what it is."""
    rng = np.random.default_rng(5)
    left, _ = fitted(rng, noise(1.0, 2e4, 1e-3))
    models = [noise(1.0, 2e4, smallness)] * len(left)
    for found in expected_noise(left, no_prior(33), models, SPAN_S):
        assert np.isfinite(found.white_K2)
        assert 0.1 < power_K2_s(found) / power_K2_s(noise(1.0, 2e4)) < 10.0


@given(
    st.lists(st.tuples(st.floats(1e-6, 1e3), st.floats(1.0, 1e7)), min_size=1, max_size=4),
    st.floats(1.0, 1e6),
)
def test_one_misfit_varies_as_much_and_grows_as_fast_as_all(parts: list[tuple[float, float]], span_s: float) -> None:
    """After a time h that is short it has moved by 2 s^2 h / length."""
    misfit = ExpectedNoise(0.01, tuple((np.float64(v), np.float64(length)) for v, length in parts)).misfit
    assert misfit is not None and [type(number) for number in misfit] == [float, float]  # goes into a file of the model
    std_K, length_s = misfit
    assert std_K**2 == pytest.approx(sum(v for v, _ in parts))
    assert std_K**2 / length_s == pytest.approx(sum(v / length for v, length in parts))
    short = no_longer(ResidualNoise(std_K, length_s, 0.1, 0.0), span_s)
    assert short.length_s <= span_s or short.length_s == length_s
    assert short.sigma_ou**2 / short.length_s == pytest.approx(std_K**2 / length_s)
    assert ExpectedNoise(0.01, ()).misfit is None
