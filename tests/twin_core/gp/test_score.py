"""Gradient and information of the log-likelihood against central differences and the dense formula."""

import numpy as np
import pytest

from twin_core.errors import ModelError
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.score import Slopes, score
from twin_core.gp.state_space import LinearModel

N_FREE = 3


def _family(dense, seed: int, n_times: int, distinct: bool = True):
    """Return the model at a parameter vector, and its slopes: every array moves along a random direction."""
    base = dense.random_model(seed, n_times=n_times, distinct=distinct)
    rng = np.random.default_rng(seed + 50)

    def spd(shape):
        root = 0.2 * rng.normal(size=shape)
        return root @ np.swapaxes(root, -1, -2)

    slopes = Slopes(
        0.1 * rng.normal(size=(N_FREE, *base.transition.shape)),
        spd((N_FREE, *base.process_cov.shape)),
        rng.normal(size=(N_FREE, *base.offset.shape)),
        0.1 * rng.uniform(size=(N_FREE, base.n_sensors)),
        rng.normal(size=(N_FREE, base.n_states)),
        spd((N_FREE, *base.prior_cov.shape)),
    )

    def at(point):
        moved = {name: getattr(base, name) + np.tensordot(point, getattr(slopes, name), 1) for name in Slopes._fields}
        return LinearModel.build(
            **moved, observation=base.observation, step_index=base.step_index, n_times=base.n_times
        )

    return at, slopes


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_gradient_is_the_central_difference(dense, seed, missing):
    at, slopes = _family(dense, seed, 20)
    _, y = dense.draw(at(np.zeros(N_FREE)), seed, missing)
    found = score(at(np.zeros(N_FREE)), slopes, y)
    assert found.log_likelihood == pytest.approx(kalman_filter(at(np.zeros(N_FREE)), y).log_likelihood, abs=1e-10)
    step = 1e-5
    for p in range(N_FREE):
        ahead, back = (kalman_filter(at(sign * step * np.eye(N_FREE)[p]), y).log_likelihood for sign in (1, -1))
        assert found.gradient[p] == pytest.approx((ahead - back) / (2 * step), rel=1e-5, abs=1e-5)


@pytest.mark.statistical
def test_information_is_fisher_on_average(dense):
    """I_ij = dμᵢᵀ Σ⁻¹ dμⱼ + ½ tr(Σ⁻¹ dΣᵢ Σ⁻¹ dΣⱼ) of the joint Gaussian; 2000 draws tell it to 5 standard errors."""
    at, slopes = _family(dense, 0, 8)

    def moments(point):
        model = at(point)
        mean, cov = dense.joint(model)
        h = np.kron(np.eye(model.n_times), model.observation)
        size = model.n_times * model.n_states
        noise = np.tile(model.noise_variance, model.n_times)
        return h @ mean.ravel(), h @ cov.reshape(size, size) @ h.T + np.diag(noise)

    step, eye = 1e-5, np.eye(N_FREE)
    pairs = [(moments(step * eye[p]), moments(-step * eye[p])) for p in range(N_FREE)]
    d_mean = [(a[0] - b[0]) / (2 * step) for a, b in pairs]
    inverse = np.linalg.inv(moments(np.zeros(N_FREE))[1])
    weighted = [inverse @ (a[1] - b[1]) / (2 * step) for a, b in pairs]
    expected = [
        [d_mean[i] @ inverse @ d_mean[j] + 0.5 * np.trace(weighted[i] @ weighted[j]) for j in range(N_FREE)]
        for i in range(N_FREE)
    ]
    model = at(np.zeros(N_FREE))
    draws = np.array([score(model, slopes, dense.draw(model, seed)[1]).information for seed in range(2000)])
    error = draws.std(axis=0) / np.sqrt(len(draws))
    assert (np.abs(draws.mean(axis=0) - expected) < 5 * error).all()


def test_settled_gains_change_nothing(dense):
    at, slopes = _family(dense, 4, 600, distinct=False)
    _, y = dense.draw(at(np.zeros(N_FREE)), 4)
    y[300:310, 1] = np.nan
    free, settled = (score(at(np.zeros(N_FREE)), slopes, y, settle_tolerance=t) for t in (-1.0, 1e-12))
    np.testing.assert_allclose(settled.gradient, free.gradient, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(settled.information, free.information, rtol=1e-9, atol=1e-8)


def test_shapes_are_checked(dense):
    at, slopes = _family(dense, 0, 5)
    with pytest.raises(ModelError, match="slopes of noise_variance have shape"):
        score(at(np.zeros(N_FREE)), slopes._replace(noise_variance=np.zeros((N_FREE, 1))), np.zeros((5, 2)))
