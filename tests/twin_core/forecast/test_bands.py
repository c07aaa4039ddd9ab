"""Quantiles of mixtures against a root finder, simultaneous bands against a closed form."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from twin_core.forecast.bands import mixture_quantiles, whole_path_factor


@pytest.mark.parametrize("probability", [0.05, 0.3, 0.5, 0.95, 0.999])
def test_quantiles_of_a_mixture(probability: float) -> None:
    rng = np.random.default_rng(1)
    std, deviations = rng.uniform(0.1, 2.0, (3, 2)), rng.normal(0.0, 5.0, (12, 3, 2))
    found = mixture_quantiles([probability], std, deviations)[probability]
    for at in np.ndindex(3, 2):
        below = lambda x, at=at: norm.cdf(x, deviations[:, *at], std[at]).mean() - probability  # noqa: E731
        assert found[at] == pytest.approx(brentq(below, -50.0, 50.0, xtol=1e-12), abs=1e-8)


def test_quantiles_of_members_far_apart_and_of_equal_ones() -> None:
    """Between clusters a quantile is flat: anywhere there will do, and the search comes to an end."""
    deviations = np.concatenate([np.zeros((24, 400)), np.full((24, 400), 1e4)])[:, :, None]
    deviations[:, 200:] = 7.0
    std = np.geomspace(1e-6, 1e3, 400)[:, None]
    for probability in (0.05, 0.5, 0.51, 0.95):
        found = mixture_quantiles([probability], std, deviations)[probability]
        np.testing.assert_allclose(norm.cdf((found - deviations) / std).mean(axis=0), probability, atol=1e-9)


def test_without_members_it_is_the_normal_quantile() -> None:
    std = np.array([[0.5], [2.0]])
    np.testing.assert_allclose(mixture_quantiles([0.95], std, np.zeros((0, 2, 1)))[0.95], norm.ppf(0.95) * std)


@pytest.mark.parametrize(("n_kept", "n_between"), [(1, 1.0), (30, 1.0), (10, 3.0), (200, 1.0)])
def test_a_band_that_holds_n_independent_readings(n_kept: int, n_between: float) -> None:
    """Pure noise: (2 Phi(c z) - 1)^n = 0.9 has a closed form."""
    z, noise = norm.ppf(0.95), np.array([0.3, 2.0])
    edge = np.broadcast_to(z * noise, (n_kept, 2))
    bands = (-edge, np.zeros_like(edge), edge)
    found = whole_path_factor(
        0.9, np.zeros((n_kept, 2, 20_000), np.float32), np.zeros((0, n_kept, 2)), noise, n_between, bands
    )
    share = 0.9 ** (1.0 / (n_kept * n_between))
    np.testing.assert_allclose(found, norm.ppf(0.5 + 0.5 * share) / z, rtol=0.01)


def test_a_path_that_moves_as_one_needs_no_wider_band() -> None:
    """One number for the whole path: what holds at one time holds at all."""
    paths = np.broadcast_to(np.random.default_rng(0).standard_normal(20_000, np.float32), (50, 1, 20_000))
    edge = np.full((50, 1), norm.ppf(0.95))
    bands = (-edge, np.zeros_like(edge), edge)
    found = whole_path_factor(0.9, np.array(paths), np.zeros((0, 50, 1)), np.array([1e-9]), 1.0, bands)
    assert found[0] == pytest.approx(1.0, abs=0.02)
