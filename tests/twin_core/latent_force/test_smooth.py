"""The smoothed force against dense Gaussian-process regression and a nonlinear network's truth."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.errors import ModelError
from twin_core.gp.kernels import Matern
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.smooth import smooth_extended, smooth_force

TIMES = np.arange(0.0, 60.0, 5.0)
CAPACITY, RATE = 40.0, 0.03


def _one_node(times=TIMES, **options) -> ForceModel:
    network = Linearised(times, np.array([[[-RATE]]]), np.zeros((times.size - 1, 2, 1)), np.array([[CAPACITY]]))
    parts = dict(observation=[[1.0]], noise_std_K=[0.2], prior_mean_K=[0.0], prior_std_K=1.5)
    return ForceModel.build(network, (0,), Matern(5), **{**parts, **options})


def _prior_covariances(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Cov(T, T), Cov(f, T), Cov(f, f) at TIMES by quadrature of T(t) = T0 e^(-at) + int e^(-a(t-s)) f(s)/C ds."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    panels = TIMES.size - 1
    points = np.concatenate([TIMES[k] + 2.5 * (1 + nodes) for k in range(panels)])
    weight = np.tile(2.5 * weights, panels)
    response = np.exp(-RATE * (TIMES[:, None] - points)) * (points < TIMES[:, None]) * weight / CAPACITY
    kernel = Matern(5)

    def k(a, b):
        return kernel.covariance(values, np.subtract.outer(a, b))

    start = 1.5**2 * np.exp(-RATE * np.add.outer(TIMES, TIMES))
    return start + response @ k(points, points) @ response.T, k(TIMES, points) @ response.T, k(TIMES, TIMES)


def test_force_is_the_dense_regression():
    """No state space in the oracle: the kernel's closed form, integrated; quadrature leaves 1e-7 of the scale."""
    values = np.array([3.0, 20.0])
    tt, ft, ff = _prior_covariances(values)
    y = np.sin(TIMES / 9.0)
    y[4] = np.nan
    seen = np.isfinite(y)
    spread = tt[np.ix_(seen, seen)] + 0.04 * np.eye(seen.sum())
    found = smooth_force(_one_node(), y, values)
    mean = ft[:, seen] @ np.linalg.solve(spread, y[seen])
    cov = ff - ft[:, seen] @ np.linalg.solve(spread, ft[:, seen].T)
    np.testing.assert_allclose(found.mean_W[:, 0], mean, atol=1e-5)
    np.testing.assert_allclose(found.std_W[:, 0], np.sqrt(np.diag(cov)), atol=1e-5)
    cross = ft.T - tt[:, seen] @ np.linalg.solve(spread, ft[:, seen].T)
    np.testing.assert_allclose(found.cross_cov_KW[:, 0, 0], np.diag(cross), atol=1e-5)
    np.testing.assert_allclose(found.force_cov_W2[:, 0, 0], found.std_W[:, 0] ** 2)


def test_unsensed_node_and_two_sensors_on_one(dense):
    """Node 0 has two sensors, node 1 none but a force: the dense posterior of the block model."""
    jacobian = np.array([[[-0.05, 0.05], [0.02, -0.03]]])
    network = Linearised(TIMES, jacobian, np.zeros((11, 2, 2)), np.array([[40.0, 90.0]]))
    model = ForceModel.build(
        network,
        (1,),
        Matern(3),
        observation=[[1.0, 0.0], [1.0, 0.0]],
        noise_std_K=[0.1, 0.3],
        prior_mean_K=[0.0, 1.0],
        prior_std_K=1.0,
    )
    values = np.array([5.0, 25.0])
    y = np.stack([np.sin(TIMES / 9), np.sin(TIMES / 9) + 0.1], axis=1)
    y[3, 0] = y[7] = np.nan
    found = smooth_force(model, y, values)
    mean, cov, total = dense.condition(model.linear_model(values), y)
    np.testing.assert_allclose(found.temperature_K, mean[:, :2], atol=1e-8)
    np.testing.assert_allclose(found.mean_W[:, 0], mean[:, 2], atol=1e-8)
    np.testing.assert_allclose(found.std_W[:, 0], np.sqrt(np.einsum("kiki->ki", cov)[:, 2]), atol=1e-8)
    assert found.log_likelihood == pytest.approx(total, abs=1e-8)


def test_without_samples_the_force_is_its_prior():
    found = smooth_force(_one_node(), np.full(TIMES.size, np.nan), np.array([3.0, 20.0]))
    np.testing.assert_allclose(found.mean_W, 0.0)
    np.testing.assert_allclose(found.std_W, 3.0)


def test_one_sample_is_enough():
    found = smooth_force(_one_node(np.array([4.0])), np.array([1.0]), np.array([3.0, 20.0]))
    assert found.temperature_K[0, 0] == pytest.approx(1.5**2 / (1.5**2 + 0.04))


def test_wrong_values_are_told():
    with pytest.raises(ModelError, match="2 positive numbers: std, length_s"):
        smooth_force(_one_node(), np.zeros(TIMES.size), np.array([3.0, -1.0]))


def _radiator(times: np.ndarray, capacity: float, area: float):
    """Return truth under a hidden heat, and the linearisation of the declared radiator."""

    def hidden(t):
        return 6.0 * np.sin(2 * np.pi * np.asarray(t) / 4000.0)

    out = solve_ivp(
        lambda t, x: (60.0 - SIGMA * area * x**4 + hidden(t)) / capacity,
        (0, times[-1]),
        [200.0],
        t_eval=times,
        rtol=1e-10,
        atol=1e-9,
    )

    def about(temperatures_K):
        rate = (60.0 - SIGMA * area * temperatures_K**4) / capacity
        slope = (-4.0 * SIGMA * area * temperatures_K**3 / capacity)[:, :, None]
        steps = np.stack([slope[:-1], slope[1:]], axis=1)
        return Linearised.about(times, temperatures_K, rate, steps, np.array([capacity]))

    return out.y.T, hidden(times), about


def test_radiator_is_linearised_about_itself():
    """A node 40 K off its nominal: one linearisation is wrong by watts, the iterated one finds the hidden heat."""
    times, capacity, area = np.arange(0.0, 8000.0, 20.0), 2000.0, 0.3
    truth, hidden, about = _radiator(times, capacity, area)
    y = truth + 0.02 * np.random.default_rng(0).normal(size=truth.shape)
    nominal = about(np.full_like(truth, 260.0))
    model = ForceModel.build(
        nominal, (0,), Matern(5), observation=[[1.0]], noise_std_K=[0.02], prior_mean_K=[200.0], prior_std_K=5.0
    )
    values = np.array([5.0, 1500.0])
    once, found = smooth_force(model, y, values), smooth_extended(model, about, y, values)
    assert found.converged and 2 < found.n_linearisations < 8
    inner = slice(20, -20)
    rms = np.sqrt(np.mean((found.mean_W[inner, 0] - hidden[inner]) ** 2))
    assert rms < 0.3 < 1.0 < np.sqrt(np.mean((once.mean_W[inner, 0] - hidden[inner]) ** 2))
    assert np.mean(np.abs(found.mean_W[:, 0] - hidden) < 1.96 * found.std_W[:, 0]) > 0.85
