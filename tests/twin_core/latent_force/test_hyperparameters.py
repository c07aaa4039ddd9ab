"""The posterior of hyperparameters: derivatives by central differences, maximum by another optimiser, blindness told."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import gamma

from twin_core.errors import ModelError
from twin_core.gp.kernels import Matern
from twin_core.latent_force.hyperparameters import fit_map
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.posterior import GammaPrior, Posterior
from twin_core.latent_force.smooth import smooth_force

TIMES = np.arange(0.0, 400.0, 4.0)
PRIORS = {"std": GammaPrior(2.0, 0.2), "length_s": GammaPrior(3.0, 0.05)}


def _network(values) -> Linearised:
    capacity = values[0] if len(values) else 50.0
    jacobian = np.array([[[-0.02, 0.02], [0.02, -0.03]]])
    return Linearised(TIMES, jacobian + 0.0 * capacity, np.zeros((TIMES.size - 1, 2, 2)), np.ones((1, 2)) * capacity)


def _model(nodes=(0, 1), names=(), noise=()) -> ForceModel:
    return ForceModel.build(
        _network,
        nodes,
        Matern(3),
        observation=np.eye(2),
        noise_std_K=[0.05, 0.05],
        prior_mean_K=[0.0, 0.0],
        prior_std_K=0.5,
        network_names=names,
        estimate_noise=noise,
    )


def _samples(seed: int) -> np.ndarray:
    """Draw from the model at std 4 W, length 60 s."""
    rng = np.random.default_rng(seed)
    linear = _model().linear_model(np.array([4.0, 60.0]))
    x = rng.multivariate_normal(linear.prior_mean, linear.prior_cov)
    y = []
    for _k in range(TIMES.size):
        y.append(linear.observation @ x + 0.05 * rng.normal(size=2))
        x = rng.multivariate_normal(linear.transition[0] @ x, linear.process_cov[0])
    y = np.array(y)
    y[30:34, 0] = np.nan
    return y


def test_gamma_prior_is_scipys():
    x = np.array([0.1, 3.0, 40.0])
    np.testing.assert_allclose(GammaPrior(5.0, 0.1).log_density(x), gamma(5.0, scale=10.0).logpdf(x))


def test_derivatives_are_central_differences():
    posterior = Posterior(_model(noise=(1,)), _samples(0), PRIORS)
    point, step = np.log([3.0, 50.0, 0.06]), 1e-4
    _, _, gradient, _ = posterior.expand(point)
    hessian, eye = posterior.hessian(point), step * np.eye(3)
    for i in range(3):
        difference = (posterior.value(point + eye[i]) - posterior.value(point - eye[i])) / (2 * step)
        assert gradient[i] == pytest.approx(difference, rel=1e-5, abs=1e-5)
        for j in range(3):
            corners = [posterior.value(point + a * eye[i] + b * eye[j]) * a * b for a in (1, -1) for b in (1, -1)]
            # Four values of ~500 nats, rounding 1e-13 each, over 4e-8: good to about 1e-4.
            assert hessian[i, j] == pytest.approx(sum(corners) / (4 * step**2), rel=1e-3, abs=2e-3)


def test_maximum_is_that_of_another_optimiser():
    y, model = _samples(1), _model()
    found = fit_map(model, y, PRIORS, {"std": (1.0, 10.0), "length_s": (20.0, 200.0)})
    posterior = Posterior(model, y, PRIORS)
    other = minimize(
        lambda p: -posterior.value(p), np.log([4.0, 60.0]), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9}
    )
    assert found.converged and (found.outcome, found.advice) == ("maximum", "None needed; heed the notices.")
    np.testing.assert_allclose(found.values, np.exp(other.x), rtol=1e-4)
    assert found.log_likelihood == pytest.approx(smooth_force(model, y, found.values).log_likelihood, abs=1e-9)
    assert found.log_posterior == pytest.approx(-other.fun, abs=1e-8)
    assert found.named()["std"] == found.values[0]


def test_laplace_covariance_is_the_curvature_in_the_values():
    y, model = _samples(2), _model()
    found = fit_map(model, y, PRIORS, {"std": 4.0, "length_s": 60.0})
    posterior = Posterior(model, y, PRIORS)

    def value(x):
        return posterior.value(np.log(x))

    step = 1e-3 * found.values
    precision = np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            a, b = step[i] * np.eye(2)[i], step[j] * np.eye(2)[j]
            corners = value(found.values + a + b) - value(found.values + a - b)
            corners += value(found.values - a - b) - value(found.values - a + b)
            precision[i, j] = -corners / (4 * step[i] * step[j])
    np.testing.assert_allclose(found.covariance, np.linalg.inv(precision), rtol=1e-3)
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(found.covariance)))


@pytest.mark.statistical
def test_truth_lies_within_the_laplace_posterior():
    """ln(parameter) of 30 draws, standardised: mean square of 60 numbers within 0.4 .. 1.9 (chi-square, 1e-4)."""
    squares = []
    for seed in range(30):
        found = fit_map(_model(), _samples(100 + seed), {}, {"std": 4.0, "length_s": 60.0})
        away = np.log(found.values) - np.log([4.0, 60.0])
        squares.append(away @ np.linalg.solve(found.log_covariance, away))
    assert 0.4 < np.sum(squares) / 60 < 1.9


def test_what_the_data_cannot_tell_is_told():
    """Without a known heat, force and capacity only enter as their ratio."""
    y, model = _samples(3), _model(names=("capacity_J_per_K",))
    prior = {**PRIORS, "capacity_J_per_K": GammaPrior(50.0, 1.0)}
    start = {"std": 4.0, "length_s": 60.0, "capacity_J_per_K": 50.0}
    found = fit_map(model, y, prior, start)
    assert any("std and capacity_J_per_K together are not identifiable" in notice for notice in found.notices)
    assert not fit_map(_model(), y, PRIORS, {"std": 4.0, "length_s": 60.0}).notices


def test_noise_is_estimated():
    found = fit_map(
        _model(noise=(0, 1)),
        _samples(4),
        {},
        {"std": 4.0, "length_s": 60.0, "noise_std_K[0]": 0.02, "noise_std_K[1]": 0.2},
    )
    np.testing.assert_allclose(found.values[2:], 0.05, rtol=0.4)


def test_wrong_names_are_told():
    y = _samples(0)
    with pytest.raises(ModelError, match="prior for 'gamma'"):
        fit_map(_model(), y, {"gamma": GammaPrior(1, 1)}, {"std": 1.0, "length_s": 1.0})
    with pytest.raises(ModelError, match="start must name the parameters std, length_s"):
        fit_map(_model(), y, {}, {"std": 1.0})
    with pytest.raises(ModelError, match="shape and rate must be positive"):
        GammaPrior(0.0, 1.0)
