"""The ends of what may come in: a clear error or the correct answer, from sample to hyperparameters."""

import warnings

import numpy as np
import pytest
from scipy.linalg import expm

from tests.helpers import central_difference
from twin_core.errors import ModelError
from twin_core.gp.kernels import Matern, Periodic
from twin_core.latent_force.hyperparameters import fit_map
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.posterior import GammaPrior
from twin_core.latent_force.regression import learn_heat_flow
from twin_core.latent_force.smooth import smooth_extended, smooth_force

TIMES = np.arange(0.0, 300.0, 5.0)
CAPACITY = 50.0
LOSSY = np.array([[-0.02, 0.02], [0.02, -0.03]])
CLOSED = np.array([[-0.02, 0.02], [0.02, -0.02]])
CUT = np.zeros((2, 2))
VALUES = np.array([4.0, 60.0])
PRIORS = {"std": GammaPrior(5.0, 1.0), "length_s": GammaPrior(3.0, 0.05)}


def _model(jacobian=LOSSY, times=TIMES, kernel=Matern(1), **options) -> ForceModel:
    network = Linearised(times, jacobian[None], np.zeros((times.size - 1, 2, 2)), np.full((1, 2), CAPACITY))
    parts = {"observation": np.eye(2), "noise_std_K": [0.05, 0.05], "prior_mean_K": [0.0, 0.0], "prior_std_K": 0.5}
    return ForceModel.build(network, (1,), kernel, **(parts | options))


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
    with pytest.raises(ModelError, match="prior_std_K: is infinite; no temperature is further than 1000 K"):
        _model(prior_std_K=[1.0, np.inf])


def _least_squares(model: ForceModel, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and deviation of every state by one QR of all equations: vague rows are small, no variance is lost."""
    linear = model.linear_model(VALUES)
    n, n_times = linear.n_states, linear.n_times
    rows, right = [], []

    def add(at: int, block: np.ndarray, value: np.ndarray) -> None:
        wide = np.zeros((block.shape[0], n * n_times))
        wide[:, n * at : n * at + block.shape[1]] = block
        rows.append(wide)
        right.append(value)

    add(0, np.diag(1.0 / np.sqrt(np.diag(linear.prior_cov))), linear.prior_mean / np.sqrt(np.diag(linear.prior_cov)))
    for k, d in enumerate(linear.step_index):
        weight = np.linalg.inv(np.linalg.cholesky(linear.process_cov[d]))
        add(k, weight @ np.hstack([-linear.transition[d], np.eye(n)]), weight @ linear.offset[k])
    for k in range(n_times):
        seen = np.isfinite(samples[k])
        weight = 1.0 / np.sqrt(linear.noise_variance[seen])
        add(k, weight[:, None] * linear.observation[seen], weight * samples[k, seen])
    q, r = np.linalg.qr(np.vstack(rows))
    inverse = np.linalg.inv(r)
    mean = inverse @ (q.T @ np.concatenate(right))
    return mean.reshape(n_times, n), np.sqrt((inverse**2).sum(axis=1)).reshape(n_times, n)


@pytest.mark.parametrize("prior_std_K", [1.0, 1e3, 4e4])
def test_a_vague_prior_is_as_good_as_any(prior_std_K):
    """One of two nodes without a sensor, a heat on it, gaps: the whole posterior against least squares, up to the limit."""
    rng = np.random.default_rng(3)
    samples = (_truth()[0] + 0.05 * rng.normal(size=(TIMES.size, 2)))[:, :1]
    samples[5:9] = np.nan
    model = _model(prior_std_K=prior_std_K, observation=np.array([[1.0, 0.0]]), noise_std_K=[0.05], drift_K2_per_s=1e-6)
    mean, std = _least_squares(model, samples)
    found = smooth_force(model, samples, VALUES)
    n = model.n_nodes
    np.testing.assert_allclose(found.temperature_std_K, std[:, :n], rtol=1e-4)
    np.testing.assert_allclose(found.std_W[:, 0], std[:, n], rtol=1e-4)
    assert (np.abs(found.temperature_K - mean[:, :n]) < 1e-4 * std[:, :n]).all()
    assert (np.abs(found.mean_W[:, 0] - mean[:, n]) < 1e-4 * std[:, n]).all()


def test_a_prior_beyond_double_precision_is_told():
    for noise, prior in ((0.05, 6e4), (1e-4, 200.0)):
        with pytest.raises(ModelError, match=r"prior_std_K\[1\]: .* more than double precision carries; give at most"):
            _model(noise_std_K=[0.3, noise], prior_std_K=[1.0, prior])
    _model(noise_std_K=[0.0, 0.0], prior_std_K=1e3)


def _network(**change) -> Linearised:
    steps = TIMES.size - 1
    parts = {"jacobian_per_s": LOSSY[None], "constant_K_per_s": np.zeros((steps, 2, 2))}
    return Linearised(**{"time_s": TIMES, "capacity_J_per_K": np.full((1, 2), CAPACITY)} | parts | change)


def _built(**change):
    given = {"observation": np.eye(2), "noise_std_K": 0.05, "prior_mean_K": 0.0, "prior_std_K": 0.5, "nodes": (1,)}
    given |= {"network": _network(), "kernel": Matern(1)} | change
    return ForceModel.build(given.pop("network"), given.pop("nodes"), given.pop("kernel"), **given)


SAMPLES = np.zeros((TIMES.size, 2))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: _built(noise_std_K=[-0.1, 0.1]), "noise_std_K: must be at least 0"),
        (lambda: _built(noise_std_K=[0.1, np.nan]), "noise_std_K: holds a number that is not finite"),
        (lambda: _built(noise_std_K=[0.1] * 3), r"noise_std_K: has shape \(3,\), it must have \(2,\)"),
        (lambda: _built(prior_std_K=-1.0), "prior_std_K: must be at least 0"),
        (lambda: _built(prior_mean_K=[np.nan, 0.0]), "prior_mean_K: holds a number that is not finite"),
        (lambda: _built(prior_mean_K="warm"), "prior_mean_K: must be numbers"),
        (lambda: _built(drift_K2_per_s=-1.0), "drift_K2_per_s: must be at least 0"),
        (lambda: _built(observation=np.eye(3)), "observation has 3 columns, the network 2 nodes"),
        (lambda: _built(nodes=(7,)), "force on node 7: there are 0 to 1"),
        (lambda: _built(nodes=(0.5,)), "force on node 0.5: there are 0 to 1"),
        (lambda: _built(nodes=(1, 1)), "force on node 1: is named twice"),
        (lambda: _built(estimate_noise=(5,)), "noise of sensor 5: there are 0 to 1"),
        (lambda: _built(estimate_noise=(-1,)), "noise of sensor -1: there are 0 to 1"),
        (lambda: _built(estimate_noise=(0, 0)), "noise of sensor 0: is named twice"),
        (
            lambda: smooth_force(_built(scheme="third-order"), SAMPLES, VALUES),
            "scheme: must be one of exact, first-order",
        ),
        (lambda: smooth_force(_built(), SAMPLES, VALUES * np.inf), "2 positive numbers"),
        (lambda: smooth_force(_built(), SAMPLES, np.array([1e200, 60.0])), "a parameter is too large or small"),
        (lambda: smooth_force(_built(), [["a", "b"]] * TIMES.size, VALUES), "observations: must be numbers"),
        (lambda: smooth_extended(_built(), lambda t: _network(), SAMPLES, VALUES, max_linearisations=0), "at least 1"),
        (lambda: _network(capacity_J_per_K=np.array([[50.0, np.inf]])), "node 1: the capacity must be positive"),
        (lambda: _network(capacity_J_per_K=np.array([[0.0, 1.0]])), "node 0: the capacity must be positive"),
        (lambda: _network(jacobian_per_s=LOSSY[None] * np.nan), "jacobian_per_s holds a number that is not finite"),
        (lambda: _network(time_s=3.0), "time_s must be"),
        (
            lambda: Linearised.about(TIMES, SAMPLES, SAMPLES, np.eye(3), np.ones(2)),
            r"shape \(1, 3, 3\) for 59 steps of 2",
        ),
        (
            lambda: fit_map(_built(), SAMPLES, PRIORS, {"std": -2.0, "length_s": 20.0}),
            "start of 'std': must be positive",
        ),
        (lambda: fit_map(_built(), SAMPLES, PRIORS, {"std": (), "length_s": 20.0}), "start of 'std': must be positive"),
        (lambda: fit_map(_built(), SAMPLES, {"std": 3.0}, {"std": 2.0, "length_s": 20.0}), "must be a GammaPrior"),
        (lambda: fit_map(_built(nodes=()), SAMPLES, {}, {}), "no parameter to fit"),
        (lambda: GammaPrior(np.inf, 1.0), "shape and rate must be positive"),
        (lambda: fit_map(_built(), SAMPLES, PRIORS, {"std": "a", "length_s": 20.0}), "start of 'std': must be numbers"),
        (lambda: smooth_force(_built(), SAMPLES, ["a", "b"]), "2 positive numbers"),
        (lambda: _built(kernel="matern"), "kernel: must be a kernel such as Matern"),
        (lambda: Matern(1) + 3, "Sum: needs kernels"),
        (lambda: Periodic(np.inf), "period_s must be positive, it is inf"),
        (lambda: Periodic(100.0, 2.5), "n_harmonics must be a whole number, it is 2.5"),
        (lambda: Matern(1, decay=-1.0), "decay must be positive"),
    ],
)
def test_nonsense_is_named_at_the_door(call, words):
    with pytest.raises(ModelError, match=words):
        call()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"only": (4,)}, "there is no force 4"),
        ({"only": (0, 0)}, "or it is named twice"),
        ({"only": (0.5,)}, "there is no force 0.5"),
        ({"degree": 2.5}, "degree must be a whole number"),
        ({"max_degree": 2.5}, "max_degree must be a whole number"),
        ({"max_degree": -1}, "max_degree must be at least 0"),
        ({"degree": -1}, "degree must be at least 0"),
        ({"boundary_K": np.zeros(3)}, "boundary_K: has shape"),
        ({"boundary_K": np.full(TIMES.size, np.nan)}, "boundary_K: holds a number that is not finite"),
        ({"vanishing": True}, "needs the boundary temperature"),
    ],
)
def test_a_regression_that_cannot_be_is_named(change, words):
    model = _built()
    found = smooth_force(model, SAMPLES, VALUES)
    with pytest.raises(ModelError, match=words):
        learn_heat_flow(model, SAMPLES, VALUES, found, **change)


def test_a_regression_along_another_record_is_named():
    model = _built()
    found = smooth_force(model, SAMPLES, VALUES)
    short = _built(network=_network(time_s=TIMES[:10], constant_K_per_s=np.zeros((9, 2, 2))))
    with pytest.raises(ModelError, match="smoothed has"):
        learn_heat_flow(short, SAMPLES[:10], VALUES, found)


def test_a_regression_at_values_that_are_none_is_named():
    model = _built()
    found = smooth_force(model, SAMPLES, VALUES)
    for values in ([-4.0, 60.0], [4.0], [4.0, np.nan]):
        with pytest.raises(ModelError, match="values must be 2 positive numbers: std, length_s"):
            learn_heat_flow(model, SAMPLES, values, found)


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


def test_without_samples_and_priors_there_is_no_maximum():
    blank = np.full((TIMES.size, 2), np.nan)
    found = fit_map(_model(), blank, {}, {"std": 2.0, "length_s": 20.0})
    assert (found.outcome, found.converged) == ("no maximum", False)
    assert "Give priors" in found.advice and np.isnan(found.covariance).all()
    assert any("std" in notice and "not identifiable" in notice for notice in found.notices)


def test_white_heat_has_no_maximum():
    """A random walk of temperature: shorter and stronger forces are ever alike, std² length alone is told."""
    walk = 0.02 * np.cumsum(np.random.default_rng(0).normal(size=(TIMES.size, 2)), axis=0)
    found = fit_map(_model(noise_std_K=0.0), walk, {}, {"std": 2.0, "length_s": 20.0})
    assert found.outcome == "no maximum" and np.isnan(found.covariance).all()
    assert found.notices == (
        "std and length_s together are not identifiable from these data: there is no prior either",
    )


def test_a_climb_that_rises_slowly_is_finished_by_newton_steps():
    """Scoring zigzags where force and noise trade; the gradient at the end is a central difference's zero."""
    walk = 0.02 * np.cumsum(np.random.default_rng(0).normal(size=(TIMES.size, 2)), axis=0)
    model = _model(estimate_noise=(0, 1))
    start = {"std": 2.0, "length_s": 20.0, "noise_std_K[0]": 0.1, "noise_std_K[1]": 0.1}
    found = fit_map(model, walk, {}, start)
    assert found.converged
    for direction in np.eye(4):

        def likelihood(x: float, direction: np.ndarray = direction) -> np.ndarray:
            return np.array(smooth_force(model, walk, found.values * np.exp(x * direction)).log_likelihood)

        assert abs(central_difference(likelihood, 0.0, 1e-3)) < 1e-3


def test_a_periodic_heat_of_any_smoothness_has_a_likelihood():
    """Down to a train of pulses: all harmonics alike, and noise that asks for more ends without a maximum, not halfway."""
    model = _model(kernel=Periodic(100.0))
    noise = 0.3 * np.random.default_rng(0).normal(size=(TIMES.size, 2))
    near, far = (smooth_force(model, noise, [4.0, s]).log_likelihood for s in (1.01e-4, 1e-12))
    assert far == pytest.approx(near, rel=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fit_map(model, noise, {}, {"std": 2.0, "smoothness": 1.0}).outcome == "no maximum"
