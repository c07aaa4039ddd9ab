"""The slope of the likelihood in the sizes of the heats, against the joint Gaussian and a filter that never settles."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tests.twin_core.latent_force.test_whitening import alike, dense_covariance, system
from twin_core.latent_force.size_score import size_score
from twin_core.latent_force.whitening import whiten_columns

STEP = 1e-5


def single(s: dict[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
    """Return a system with one column of readings instead of several."""
    return {**s, "columns": np.random.default_rng(seed).normal(size=(*s["valid"].shape, 1))}


def slope_of(value: Callable[[dict[str, np.ndarray]], float], s: dict[str, np.ndarray], step: float) -> np.ndarray:
    """Return the central differences of a function of a system in ln of the size of each heat."""
    slope = []
    for i in range(s["force_variance"].size):
        factors = np.ones(s["force_variance"].size)
        factors[i] = np.exp(2.0 * step)  # the size is the root of the variance
        up, down = ({**s, "force_variance": s["force_variance"] * f} for f in (factors, 1.0 / factors))
        slope.append((value(up) - value(down)) / (2.0 * step))
    return np.array(slope)


@pytest.mark.parametrize("seed", range(4))
def test_the_slope_is_that_of_the_joint_gaussian(seed: int) -> None:
    """Steps all unlike, several between samples, readings missing."""
    s = single(system(seed), seed)
    readings = s["columns"][:, :, 0][s["valid"]]

    def dense(of: dict[str, np.ndarray]) -> float:
        likelihood = multivariate_normal(np.zeros(readings.size), dense_covariance(of)).logpdf(readings)
        return float(likelihood + 0.5 * readings.size * np.log(2.0 * np.pi))

    value, slope = size_score(**s)
    assert value == pytest.approx(dense(s), rel=1e-9)
    np.testing.assert_allclose(slope, slope_of(dense, s, STEP), rtol=1e-5, atol=1e-6)


def test_an_adjoint_that_has_settled_is_the_adjoint_that_never_does() -> None:
    s = single(alike(2400), 0)
    never = {**s, "interval": np.full(s["kind"].size, -1)}
    value, slope = size_score(**s)
    slowly, whole = size_score(**never)
    assert value == pytest.approx(slowly, rel=1e-7)
    np.testing.assert_allclose(slope, whole, rtol=1e-4)

    def filtered(of: dict[str, np.ndarray]) -> float:
        whitened, log_det = whiten_columns(**of)
        return -0.5 * (float((whitened**2).sum()) + log_det)

    np.testing.assert_allclose(slope, slope_of(filtered, never, 1e-4), rtol=1e-4)


def test_a_heat_of_no_size_has_no_slope() -> None:
    s = single(system(0), 0)
    s["force_variance"][1] = 0.0
    assert size_score(**s)[1][1] == 0.0
