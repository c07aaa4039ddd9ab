"""The latent heat of the search: the same model in both its forms, and the paper's kernel in its steps."""

import numpy as np
import pytest

from twin_core.gp.discretise import discretise
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.kernels import Matern
from twin_core.latent_force.held import HeldForce, grid_of
from twin_core.simulate.one_step import Steps

N, N_STEPS, N_SAMPLES = 3, 40, 17


def _steps(rng: np.random.Generator) -> Steps:
    transition = 0.9 * np.eye(N) + 0.04 * rng.normal(size=(N_STEPS, N, N))
    response = 1e-2 * (np.eye(N) + 0.1 * rng.normal(size=(N_STEPS, N, N)))
    return Steps(np.zeros((N_STEPS, N)), np.zeros((N_STEPS, 2, N)), transition, response)


def _force(rng: np.random.Generator) -> HeldForce:
    return HeldForce(
        step_s=rng.uniform(10.0, 90.0, N_STEPS),
        std_W=np.array([5.0, 0.0, 20.0]),
        length_s=200.0,
        floor_K2=np.full(N, 1e-8),
        sensor_node=np.array([2, 0], dtype=np.int64),
        noise_K=np.array([0.1, 0.3]),
        start_std_K=np.array([2.0, 20.0, 0.5]),
    )


@pytest.mark.parametrize("seed", range(3))
def test_whitened_readings_have_the_likelihood_of_the_filter(seed):
    """Two separate codes, one of them checked densely: ln p(y) over readings with gaps, samples on some steps alone."""
    rng = np.random.default_rng(seed)
    steps, force = _steps(rng), _force(rng)
    drift, start = rng.normal(size=(N_STEPS, N)), rng.normal(size=N)
    at = np.sort(rng.choice(N_STEPS + 1, N_SAMPLES, replace=False))
    sample_of = np.full(N_STEPS + 1, -1, dtype=np.int64)
    sample_of[at] = np.arange(N_SAMPLES)
    valid = rng.random((N_SAMPLES, 2)) < 0.8
    read = np.where(valid, rng.normal(scale=3.0, size=(N_SAMPLES, 2)), np.nan)
    stretched = np.full((N_STEPS + 1, 2), np.nan)
    stretched[at] = read
    filtered = kalman_filter(force.linear_model(steps, drift, start), stretched, keep="likelihood")
    mean = [start]
    for k in range(N_STEPS):
        mean.append(steps.transition[k] @ mean[-1] + drift[k])
    away = read - np.array(mean)[at][:, force.sensor_node]
    means = grid_of(force.step_s, sample_of, valid).means_of(steps)
    whitened, log_det = force.whiten(away[:, :, None], means, sample_of, valid)
    total = -0.5 * (float((whitened**2).sum()) + log_det + int(valid.sum()) * np.log(2.0 * np.pi))
    assert total == pytest.approx(filtered.log_likelihood, rel=1e-10)


def test_the_heat_is_the_papers_kernel():
    """Decay and growth of every step against the Matérn-1/2 process discretised by the room next door."""
    rng = np.random.default_rng(0)
    steps, force = _steps(rng), _force(rng)
    model = force.linear_model(steps, np.zeros((N_STEPS, N)), np.zeros(N))
    block = Matern(1, decay=1.0).block(np.array([5.0, 200.0]))
    exact = discretise(block.feedback, block.diffusion, force.step_s)
    np.testing.assert_allclose(model.transition[:, N, N], exact.transition[:, 0, 0], rtol=1e-12)
    np.testing.assert_allclose(model.process_cov[:, N, N], exact.process_cov[:, 0, 0], rtol=1e-12)
    assert model.prior_cov[N, N] == pytest.approx(25.0)
