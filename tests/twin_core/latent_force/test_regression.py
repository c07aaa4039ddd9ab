"""A heat flow learned in the heat balance: evidence by a second route, recovery, bands that are neither wide nor narrow."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.errors import ModelError
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.kernels import Matern
from twin_core.gp.state_space import LinearModel
from twin_core.latent_force import evidence, regression
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.regression import learn_heat_flow
from twin_core.latent_force.smooth import smooth_force

TIMES = np.arange(0.0, 1200.0, 6.0)
CAPACITY, GL, AMBIENT_K, NOISE_K = 300.0, 1.5, 293.0, 0.03


def _hidden(t):
    return -0.02 * (t - AMBIENT_K) ** 2


def _input(time_s):
    return 60.0 * (np.asarray(time_s) % 600.0 < 300.0)


def _truth() -> np.ndarray:
    """Two nodes, the first heated in pulses; a hidden quadratic loss from both."""

    def rate(t, x, heat):
        exchange = GL * (x[1] - x[0])
        return (np.array([heat + exchange, -exchange]) - 0.5 * (x - AMBIENT_K) + _hidden(x)) / CAPACITY

    parts, x = [np.full((1, 2), AMBIENT_K)], np.full(2, AMBIENT_K)
    for start in np.arange(0.0, 1200.0, 300.0):
        times = TIMES[(TIMES > start) & (TIMES <= start + 300.0)]
        heat = float(_input(start))
        out = solve_ivp(rate, (start, times[-1]), x, t_eval=times, args=(heat,), rtol=1e-10, atol=1e-10)
        parts.append(out.y.T)
        x = out.y[:, -1]
    return np.concatenate(parts)


TRUTH = _truth()


def _model(kernel=None) -> ForceModel:
    jacobian = np.array([[-GL - 0.5, GL], [GL, -GL - 0.5]])[None] / CAPACITY
    constant = np.full((TIMES.size - 1, 2, 2), 0.5 * AMBIENT_K)
    constant[:, :, 0] += _input(TIMES[:-1])[:, None]
    network = Linearised(TIMES, jacobian, constant / CAPACITY, np.full((1, 2), CAPACITY))
    return ForceModel.build(
        network,
        (0, 1),
        kernel or Matern(3),
        observation=np.eye(2),
        noise_std_K=[NOISE_K, NOISE_K],
        prior_mean_K=[AMBIENT_K, AMBIENT_K],
        prior_std_K=1.0,
    )


def _samples(seed: int) -> np.ndarray:
    y = TRUTH + NOISE_K * np.random.default_rng(seed).normal(size=TRUTH.shape)
    y[20:30, 1] = np.nan
    return y


VALUES = np.array([4.0, 200.0])


def test_evidence_by_a_second_route(monkeypatch):
    """Weights as constant states with their prior: the augmented filter's likelihood is the ridge's evidence."""
    model, y = _model(), _samples(0)
    smoothed = smooth_force(model, y, VALUES)
    monkeypatch.setattr(regression, "MISFIT_SHARES", (0.1,))
    found = learn_heat_flow(model, y, VALUES, smoothed, degree=2)
    bases = [regression.Basis.over(2, smoothed.temperature_K[:, node]) for node in (0, 1)]
    offsets = regression._responses(model, VALUES, smoothed, model.forces, bases, None)
    base = model.linear_model(np.array([0.4, 200.0]))
    n, extra = base.n_states, offsets.shape[0]
    transition = np.zeros((TIMES.size - 1, n + extra, n + extra))
    transition[:, :n, :n] = base.transition[base.step_index]
    transition[:, :n, n:] = offsets.transpose(1, 2, 0)
    transition[:, n:, n:] = np.eye(extra)
    cov = np.zeros((n + extra, n + extra))
    cov[:n, :n] = base.prior_cov
    scales = np.maximum(4.0, np.sqrt(np.mean(smoothed.mean_W**2, axis=0)))
    cov[range(n, n + extra), range(n, n + extra)] = np.repeat(scales**2, 3)
    augmented = LinearModel.build(
        transition=transition,
        process_cov=np.pad(base.process_cov[base.step_index], ((0, 0), (0, extra), (0, extra))),
        offset=np.pad(base.offset, ((0, 0), (0, extra))),
        observation=np.pad(base.observation, ((0, 0), (0, extra))),
        noise_variance=base.noise_variance,
        prior_mean=np.pad(base.prior_mean, (0, extra)),
        prior_cov=cov,
        n_times=TIMES.size,
    )
    filtered = kalman_filter(augmented, y)
    assert found.log_evidence == pytest.approx(filtered.log_likelihood, abs=1e-6)
    weights = np.concatenate([p.mean_W for p in found.polynomials])
    np.testing.assert_allclose(weights, filtered.mean[-1, n:], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.polynomials[1].cov_W2, filtered.cov[-1, n + 3 :, n + 3 :], rtol=1e-5, atol=1e-8)


def test_a_quadratic_loss_is_found():
    """The force in the mean to 0.2 W of 8 W; degree two by evidence; a line is told to be worse."""
    model, y = _model(), _samples(1)
    found = learn_heat_flow(model, y, VALUES, smooth_force(model, y, VALUES))
    assert found.degrees[0] == 2
    assert found.evidence_by_degree[2] > found.evidence_by_degree[1] + 10
    for node, polynomial in enumerate(found.polynomials):
        heat = polynomial.predict(TRUTH[:, node])
        assert not heat.outside[20:].any()
        assert np.sqrt(np.mean((heat.mean_W - _hidden(TRUTH[:, node])) ** 2)) < 0.2
        assert np.sqrt(np.mean(heat.std_W**2)) < 0.5


def test_boundary_makes_the_heat_vanish_with_the_difference():
    """The truth vanishes at ambient; the evidence prefers the form that says so."""
    model, y = _model(), _samples(2)
    found = learn_heat_flow(model, y, VALUES, smooth_force(model, y, VALUES), boundary_K=np.full(TIMES.size, AMBIENT_K))
    assert all(p.basis.vanishing for p in found.polynomials)
    at_ambient = found.polynomials[0].predict(np.array(AMBIENT_K), np.array(AMBIENT_K))
    # Held at the edge of the smoothed range, which ends some mK above ambient.
    assert at_ambient.mean_W == pytest.approx(0.0, abs=1e-3)


def test_nothing_missing_is_nothing_learned():
    """Data drawn from the declared network itself: the learned heat is zero within its band."""
    rng = np.random.default_rng(3)
    model = _model()
    linear = model.linear_model(np.array([1e-6, 200.0]))
    x, rows = np.concatenate([np.full(2, AMBIENT_K), np.zeros(4)]), []
    for k in range(TIMES.size):
        rows.append(x[:2] + NOISE_K * rng.normal(size=2))
        if k < TIMES.size - 1:
            x = linear.transition[linear.step_index[k]] @ x + linear.offset[k]
    y = np.array(rows)
    found = learn_heat_flow(model, y, VALUES, smooth_force(model, y, VALUES))
    for node, polynomial in enumerate(found.polynomials):
        heat = polynomial.predict(y[:, node])
        assert (np.abs(heat.mean_W) < 3 * heat.std_W).all()
        assert np.sqrt(np.mean(heat.mean_W**2)) < 0.3


def test_many_forces_are_searched_one_after_the_other(monkeypatch):
    """Above the exhaustive limit the search is by coordinates; here both end at the same degrees."""
    model, y = _model(), _samples(4)
    smoothed = smooth_force(model, y, VALUES)
    full = learn_heat_flow(model, y, VALUES, smoothed)
    monkeypatch.setattr(evidence, "EXHAUSTIVE", 1)
    assert learn_heat_flow(model, y, VALUES, smoothed).degrees == full.degrees


@pytest.mark.statistical
def test_bands_cover_over_seeds():
    """Mean coverage of 90 % bands over 30 seeds and 2 nodes: within 0.80 .. 0.98, curves of a seed move together."""
    model, covered = _model(), []
    for seed in range(30):
        y = _samples(100 + seed)
        found = learn_heat_flow(model, y, VALUES, smooth_force(model, y, VALUES), degree=2)
        for node, polynomial in enumerate(found.polynomials):
            heat = polynomial.predict(TRUTH[:, node])
            covered.append(np.mean(np.abs(heat.mean_W - _hidden(TRUTH[:, node])) < 1.645 * heat.std_W))
    assert 0.80 < np.mean(covered) < 0.98


def test_a_model_without_force_is_told():
    model = _model()
    bare = ForceModel.build(
        model.network(np.zeros(0)),
        (),
        Matern(3),
        observation=np.eye(2),
        noise_std_K=[NOISE_K, NOISE_K],
        prior_mean_K=[AMBIENT_K, AMBIENT_K],
        prior_std_K=1.0,
    )
    y = _samples(0)
    with pytest.raises(ModelError, match="no latent force"):
        learn_heat_flow(bare, y, np.zeros(0), smooth_force(bare, y, np.zeros(0)))


def test_one_force_is_learned_while_the_other_stays():
    """Alone, with the other force as free as before, the curve is the same within its band, and in its own place."""
    shared, y = _model(), _samples(4)
    model = ForceModel.build(
        shared.network(np.zeros(0)),
        (0, 1),
        shared.forces[0].kernel,
        observation=shared.observation,
        noise_std_K=shared.noise_std_K,
        prior_mean_K=shared.prior_mean_K,
        prior_std_K=shared.prior_std_K,
        shared=False,
    )
    values = np.tile(VALUES, 2)
    smoothed = smooth_force(model, y, values)
    (both, alone) = (learn_heat_flow(model, y, values, smoothed, degree=2, only=only) for only in (None, [1]))
    assert len(alone.polynomials) == 1 and alone.misfit_W.shape == (1,)
    at = TRUTH[:, 1]
    together, single = both.polynomials[1].predict(at), alone.polynomials[0].predict(at)
    assert (np.abs(together.mean_W - single.mean_W) < 2.0 * single.std_W).all()
    swapped = learn_heat_flow(model, y, values, smoothed, degree=2, only=[1, 0])
    assert swapped.log_evidence == pytest.approx(both.log_evidence, abs=1e-6)
    np.testing.assert_allclose(swapped.polynomials[0].mean_W, both.polynomials[1].mean_W, rtol=1e-6, atol=1e-8)
    with pytest.raises(ModelError, match="shares hyperparameters"):
        learn_heat_flow(shared, y, VALUES, smoothed, only=[1])
