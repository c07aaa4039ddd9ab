"""Every kernel's differential equation against its own closed form; derivatives by complex step."""

import numpy as np
import pytest
from scipy.linalg import expm

from twin_core.errors import ModelError
from twin_core.gp.kernels import Kernel, Matern, Periodic, Sum

KERNELS: list[tuple[Kernel, list[float]]] = [
    (Matern(1), [2.0, 30.0]),
    (Matern(1, decay=np.sqrt(3.0)), [2.0, 30.0]),
    (Matern(3), [0.7, 12.0]),
    (Matern(5), [3.0, 80.0]),
    (Periodic(100.0), [2.0, 0.8]),
    (Periodic(100.0, 3, forgets=True), [2.0, 1.5, 400.0]),
    (Matern(3) + Periodic(100.0) + Matern(1), [2.0, 30.0, 1.0, 0.8, 0.5, 5.0]),
]
LAGS = np.array([0.0, 0.3, 7.0, 50.0, 130.0])
ids = [str(k) for k, _ in KERNELS]


@pytest.mark.parametrize(("kernel", "values"), KERNELS, ids=ids)
def test_state_space_is_the_covariance(kernel, values):
    block = kernel.block(np.array(values))
    h, p = block.observation, block.stationary_cov
    found = [h @ expm(block.feedback * lag) @ p @ h for lag in LAGS]
    np.testing.assert_allclose(found, kernel.covariance(np.array(values), LAGS), atol=1e-12)


@pytest.mark.parametrize(("kernel", "values"), KERNELS, ids=ids)
def test_prior_is_stationary(kernel, values):
    block = kernel.block(np.array(values))
    balance = block.feedback @ block.stationary_cov + block.stationary_cov @ block.feedback.T + block.diffusion
    np.testing.assert_allclose(balance, 0.0, atol=1e-12)
    assert np.linalg.eigvalsh(block.stationary_cov).min() > 0


@pytest.mark.parametrize(("kernel", "values"), KERNELS, ids=ids)
def test_complex_step_is_the_derivative(kernel, values):
    assert len(kernel.names) == len(values)
    for p in range(len(values)):
        moved = np.array(values, dtype=complex)
        moved[p] += 1e-30j
        block = kernel.block(moved)
        step = 1e-6 * values[p]
        ahead, back = (kernel.block(np.array(values) + sign * step * np.eye(len(values))[p]) for sign in (1, -1))
        for name in ("feedback", "diffusion", "stationary_cov"):
            expected = (getattr(ahead, name) - getattr(back, name)) / (2 * step)
            np.testing.assert_allclose(np.imag(getattr(block, name)) / 1e-30, expected, atol=1e-7)


def test_periodic_kernel_tends_to_its_full_form():
    """Against exp(-2 sin²(pi lag / period) / s²) itself: eight harmonics leave 1e-8 at s = 1."""
    lags = np.linspace(0.0, 200.0, 41)
    full = np.exp(-2.0 * np.sin(np.pi * lags / 100.0) ** 2)
    np.testing.assert_allclose(Periodic(100.0, 8).covariance(np.array([1.0, 1.0]), lags), full, atol=1e-8)


def test_sums_are_flat():
    assert len((Matern(1) + (Matern(3) + Matern(5))).parts) == 3
    assert Sum((Matern(1), Matern(3))).names == ("std_1", "length_s_1", "std_2", "length_s_2")


def test_bad_structure_is_told():
    with pytest.raises(ModelError, match="half_order"):
        Matern(2)
    with pytest.raises(ModelError, match="period_s"):
        Periodic(0.0)
