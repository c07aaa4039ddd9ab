"""The ends of what may come in: a clear error or the correct answer, from sample to hyperparameters."""

import numpy as np
import pytest
from scipy.linalg import expm

from twin_core.errors import ModelError
from twin_core.gp.kernels import Matern
from twin_core.latent_force.hyperparameters import GammaPrior, fit_map
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.regression import learn_heat_flow
from twin_core.latent_force.smooth import smooth_force

TIMES = np.arange(0.0, 300.0, 5.0)
CAPACITY = 50.0
LOSSY = np.array([[-0.02, 0.02], [0.02, -0.03]])
CLOSED = np.array([[-0.02, 0.02], [0.02, -0.02]])
CUT = np.zeros((2, 2))
VALUES = np.array([4.0, 60.0])
PRIORS = {"std": GammaPrior(5.0, 1.0), "length_s": GammaPrior(3.0, 0.05)}


def _model(jacobian=LOSSY, times=TIMES, **options) -> ForceModel:
    network = Linearised(times, jacobian[None], np.zeros((times.size - 1, 2, 2)), np.full((1, 2), CAPACITY))
    parts = {"observation": np.eye(2), "noise_std_K": [0.05, 0.05], "prior_mean_K": [0.0, 0.0], "prior_std_K": 0.5}
    return ForceModel.build(network, (1,), Matern(1), **(parts | options))


def _truth(jacobian=LOSSY) -> tuple[np.ndarray, np.ndarray]:
    """Return temperatures and heat: a constant heat into the second node, by the matrix exponential."""
    heat = 3.0
    full = np.zeros((3, 3))
    full[:2, :2], full[1, 2] = jacobian, 1.0 / CAPACITY
    states = np.array([expm(full * t) @ [0.2, -0.1, heat] for t in TIMES])
    return states[:, :2], np.full(TIMES.size, heat)


@pytest.mark.parametrize("jacobian", [CLOSED, CUT], ids=["closed", "cut apart"])
def test_singular_networks_are_as_good_as_others(jacobian):
    """No loss to anywhere, or no exchange at all: the heat balance has no steady state, the heat is found all the same."""
    states, heat = _truth(jacobian)
    model = _model(jacobian)
    found = smooth_force(model, states, VALUES)
    inner = slice(5, -5)
    np.testing.assert_allclose(found.mean_W[inner, 0], heat[inner], atol=0.15)
    np.testing.assert_allclose(found.temperature_K, states, atol=0.03)


def test_without_noise_the_temperatures_are_the_samples():
    states, heat = _truth()
    found = smooth_force(_model(noise_std_K=[0.0, 0.0]), states, VALUES)
    np.testing.assert_allclose(found.temperature_K, states, atol=1e-7)
    np.testing.assert_allclose(found.mean_W[5:-5, 0], heat[5:-5], atol=0.05)
    assert np.isfinite(found.std_W).all() and np.isfinite(found.log_likelihood)


def test_infinite_prior_is_told():
    with pytest.raises(ModelError, match="prior_cov holds a number that is not finite"):
        smooth_force(_model(prior_std_K=np.inf), _truth()[0], VALUES)


def test_vague_prior_is_the_limit():
    """1e5 K and 1e6 K of ignorance say the same."""
    states, _ = _truth()
    wide, wider = (smooth_force(_model(prior_std_K=s), states, VALUES) for s in (1e5, 1e6))
    np.testing.assert_allclose(wide.mean_W, wider.mean_W, atol=1e-5)
    np.testing.assert_allclose(wide.std_W, wider.std_W, rtol=1e-5)


def test_nothing_seen_leaves_the_prior():
    """All missing: the maximum is the mode (shape - 1) / rate of each Gamma prior."""
    blank = np.full((TIMES.size, 2), np.nan)
    fit = fit_map(_model(), blank, PRIORS, {"std": 2.0, "length_s": 20.0})
    np.testing.assert_allclose(fit.values, [4.0, 40.0], rtol=1e-4)
    assert fit.log_likelihood == 0.0 and any("not identifiable" in notice for notice in fit.notices)


def test_one_sample_leaves_almost_the_prior():
    fit = fit_map(_model(times=np.array([0.0])), np.array([[0.1, 0.1]]), PRIORS, {"std": 2.0, "length_s": 20.0})
    np.testing.assert_allclose(fit.values, [4.0, 40.0], rtol=1e-3)


@pytest.mark.parametrize("times", [[0.0, 5.0, 5.0], [0.0, 5.0, 4.0], [0.0, np.nan, 5.0]])
def test_times_must_increase(times):
    with pytest.raises(ModelError, match="increas"):
        smooth_force(_model(times=np.array(times)), np.zeros((3, 2)), VALUES)


def test_shapes_and_infinite_samples_are_told():
    with pytest.raises(ModelError, match="observations have shape"):
        smooth_force(_model(), np.zeros((TIMES.size, 3)), VALUES)
    spoilt = np.zeros((TIMES.size, 2))
    spoilt[7, 1] = np.inf
    with pytest.raises(ModelError, match="row 7, sensor 1 is infinite"):
        smooth_force(_model(), spoilt, VALUES)


def test_regression_without_samples_keeps_its_prior():
    """All missing: no evidence for or against a curve."""
    model, blank = _model(), np.full((TIMES.size, 2), np.nan)
    found = smooth_force(model, blank, VALUES)
    learned = learn_heat_flow(model, blank, VALUES, found, degree=1)
    assert learned.log_bayes_factor == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(learned.polynomials[0].mean_W, 0.0, atol=1e-9)


def test_separate_hyperparameters_tell_the_forces_apart():
    """Heat into one node of two: shared, both forces get one size; apart, the idle one shrinks."""
    rng = np.random.default_rng(2)
    heat = 4.0 * np.sin(TIMES / 25.0)
    model = _model()
    network = model.network(np.zeros(0))
    states = np.zeros((TIMES.size, 2))
    fine = 200
    for k in range(TIMES.size - 1):
        x, step = states[k], (TIMES[1] - TIMES[0]) / fine
        for j in range(fine):
            t = TIMES[k] + (j + 0.5) * step
            x = x + step * (LOSSY @ x + np.array([0.0, np.interp(t, TIMES, heat)]) / CAPACITY)
        states[k + 1] = x
    y = states + 0.05 * rng.normal(size=states.shape)
    apart = ForceModel.build(
        network,
        (0, 1),
        Matern(1),
        observation=np.eye(2),
        noise_std_K=[0.05, 0.05],
        prior_mean_K=[0.0, 0.0],
        prior_std_K=0.5,
        shared=False,
    )
    priors = {f"{name}[{k}]": PRIORS[name] for name in PRIORS for k in (0, 1)}
    fit = fit_map(apart, y, priors, {"std[0]": 2.0, "length_s[0]": 40.0, "std[1]": 2.0, "length_s[1]": 40.0}).named()
    assert fit["std[0]"] < 0.5 * fit["std[1]"]
