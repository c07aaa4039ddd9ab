"""Oracle for small sizes: the joint Gaussian of all states and samples, written out and conditioned at once."""

import numpy as np
from scipy.stats import multivariate_normal

from twin_core.gp.state_space import LinearModel


def joint(model: LinearModel) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (n_times, n) and covariance (n_times, n, n_times, n) of all states before any sample."""
    n, n_times = model.n_states, model.n_times
    mean = np.zeros((n_times, n))
    cov = np.zeros((n_times, n, n_times, n))
    mean[0], cov[0, :, 0, :] = model.prior_mean, model.prior_cov
    for k in range(n_times - 1):
        a = model.transition[model.step_index[k]]
        mean[k + 1] = a @ mean[k] + model.offset[k]
        for past in range(k + 1):
            cov[k + 1, :, past, :] = a @ cov[k, :, past, :]
            cov[past, :, k + 1, :] = cov[k + 1, :, past, :].T
        cov[k + 1, :, k + 1, :] = a @ cov[k, :, k, :] @ a.T + model.process_cov[model.step_index[k]]
    return mean, cov


def condition(model: LinearModel, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return posterior mean (n_times, n), covariance (n_times, n, n_times, n) and ln p(y)."""
    n, n_times = model.n_states, model.n_times
    mean, cov = joint(model)
    flat_mean, flat_cov = mean.ravel(), cov.reshape(n_times * n, n_times * n)
    rows, noise, seen = [], [], []
    for k in range(n_times):
        for s in range(model.n_sensors):
            if np.isfinite(y[k, s]):
                row = np.zeros(n_times * n)
                row[k * n : (k + 1) * n] = model.observation[s]
                rows.append(row)
                noise.append(model.noise_variance[s])
                seen.append(y[k, s])
    if not rows:
        return mean, cov, 0.0
    h, values = np.array(rows), np.array(seen)
    spread = h @ flat_cov @ h.T + np.diag(noise)
    gain = np.linalg.solve(spread, h @ flat_cov).T
    posterior = flat_mean + gain @ (values - h @ flat_mean)
    left = flat_cov - gain @ h @ flat_cov
    total = multivariate_normal(h @ flat_mean, spread, allow_singular=False).logpdf(values)
    return posterior.reshape(n_times, n), left.reshape(n_times, n, n_times, n), float(total)


def random_model(seed: int, n_times: int = 12, n: int = 3, m: int = 2, distinct: bool = True) -> LinearModel:
    """Return a stable random model with time-varying matrices."""
    rng = np.random.default_rng(seed)
    count = n_times - 1 if distinct else 1
    a = 0.8 * np.eye(n) + 0.15 * rng.normal(size=(count, n, n))
    root = 0.4 * rng.normal(size=(count, n, n))
    q = root @ root.transpose(0, 2, 1)
    prior = rng.normal(size=(n, n))
    return LinearModel.build(
        transition=a,
        process_cov=q,
        observation=rng.normal(size=(m, n)),
        noise_variance=rng.uniform(0.05, 1.0, m),
        prior_mean=rng.normal(size=n),
        prior_cov=prior @ prior.T,
        n_times=n_times,
        offset=rng.normal(size=(n_times - 1, n)),
    )


def draw(model: LinearModel, seed: int, missing: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return states (n_times, n) and samples (n_times, n_sensors) drawn from the model."""
    rng = np.random.default_rng(seed)
    x = np.zeros((model.n_times, model.n_states))
    x[0] = rng.multivariate_normal(model.prior_mean, model.prior_cov)
    roots = [np.linalg.cholesky(q + 1e-14 * np.eye(model.n_states)) for q in model.process_cov]
    for k in range(model.n_times - 1):
        d = model.step_index[k]
        x[k + 1] = model.transition[d] @ x[k] + model.offset[k] + roots[d] @ rng.normal(size=model.n_states)
    y = x @ model.observation.T + np.sqrt(model.noise_variance) * rng.normal(size=(model.n_times, model.n_sensors))
    y[rng.random(y.shape) < missing] = np.nan
    return x, y
