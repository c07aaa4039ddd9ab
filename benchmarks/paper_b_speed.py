"""Filter plus smoother beside dynamax (jit, warmed up) and statsmodels: same likelihood, seconds, and memory at 10⁶.

All three get the same six-state model (three blocks and their forces), three sensors, the same samples, and return
smoothed means and covariances. Where a library is not installed its column says so.
"""

import resource
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from time import perf_counter

import numpy as np

from benchmarks.paper_b_simulated import PAPER_KERNEL, force_model
from twin_core._typing import FloatArray
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.smoother import smooth
from twin_core.gp.state_space import LinearModel

VALUES = np.array([3.8, 500.0])
REPEATS = 3


@dataclass(frozen=True)
class Timing:
    """One library on one record: best time of several runs, log-likelihood, mean of the smoothed first force."""

    library: str
    n_times: int
    seconds: float
    log_likelihood: float


def problem(n_times: int) -> tuple[LinearModel, FloatArray]:
    """Return the six-state model and a record drawn from it."""
    short = force_model(PAPER_KERNEL).linear_model(VALUES)
    a, q = short.transition[0], short.process_cov[0]
    model = LinearModel.build(
        transition=a,
        process_cov=q,
        offset=short.offset[-1],
        observation=short.observation,
        noise_variance=short.noise_variance,
        prior_mean=short.prior_mean,
        prior_cov=short.prior_cov,
        n_times=n_times,
    )
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(q + 1e-18 * np.eye(6))
    x, shocks = short.prior_mean.copy(), rng.normal(size=(n_times, 6))
    y = np.empty((n_times, 3))
    for k in range(n_times):
        y[k] = x[:3]
        x = a @ x + short.offset[-1] + root @ shocks[k]
    return model, y + np.sqrt(short.noise_variance) * rng.normal(size=y.shape)


def _best(call: Callable[[], float]) -> tuple[float, float]:
    """Run once to warm up, then return the best time of several runs, and the last log-likelihood."""
    total, seconds = call(), []
    for _ in range(REPEATS):
        begin = perf_counter()
        total = call()
        seconds.append(perf_counter() - begin)
    return min(seconds), total


def time_ours(model: LinearModel, y: FloatArray, settle_tolerance: float) -> tuple[float, float]:
    """Time this repository's filter and smoother; a negative tolerance never reuses gains."""

    def call() -> float:
        filtered = kalman_filter(model, y, settle_tolerance=settle_tolerance)
        smooth(model, filtered, settle_tolerance=settle_tolerance)
        return filtered.log_likelihood

    return _best(call)


def time_dynamax(model: LinearModel, y: FloatArray) -> tuple[float, float]:
    """Time dynamax in double precision, compiled."""
    import jax
    import jax.numpy as jnp
    from dynamax.linear_gaussian_ssm import LinearGaussianSSM, lgssm_smoother

    jax.config.update("jax_enable_x64", True)
    ssm = LinearGaussianSSM(6, 3)
    params, _ = ssm.initialize(
        jax.random.PRNGKey(0),
        initial_mean=jnp.asarray(model.prior_mean),
        initial_covariance=jnp.asarray(model.prior_cov),
        dynamics_weights=jnp.asarray(model.transition[0]),
        dynamics_bias=jnp.asarray(model.offset[0]),
        dynamics_covariance=jnp.asarray(model.process_cov[0]),
        emission_weights=jnp.asarray(model.observation),
        emission_bias=jnp.zeros(3),
        emission_covariance=jnp.diag(jnp.asarray(model.noise_variance)),
    )
    run = jax.jit(lambda samples: lgssm_smoother(params, samples))
    samples = jnp.asarray(y)

    def call() -> float:
        out = run(samples)
        jax.block_until_ready(out.smoothed_covariances)
        return float(out.marginal_loglik)

    return _best(call)


def time_statsmodels(model: LinearModel, y: FloatArray) -> tuple[float, float]:
    """Time statsmodels' compiled filter and smoother (states and covariances only)."""
    from statsmodels.tsa.statespace.kalman_smoother import SMOOTHER_STATE, SMOOTHER_STATE_COV, KalmanSmoother

    engine = KalmanSmoother(k_endog=3, k_states=6, k_posdef=6)
    engine.bind(np.asfortranarray(y.T))
    engine["transition"], engine["design"] = model.transition[0], model.observation
    engine["selection"], engine["state_cov"] = np.eye(6), model.process_cov[0]
    engine["obs_cov"], engine["state_intercept"] = np.diag(model.noise_variance), model.offset[0][:, None]
    engine.initialize_known(model.prior_mean, model.prior_cov)

    def call() -> float:
        return float(engine.smooth(smoother_output=SMOOTHER_STATE | SMOOTHER_STATE_COV).llf)

    return _best(call)


def compare(sizes: tuple[int, ...]) -> tuple[list[Timing], list[str]]:
    """Time every installed library at every size; also return a line for each that is missing."""
    timings, notices = [], []
    others = {"dynamax": time_dynamax, "statsmodels": time_statsmodels}
    for name in list(others):
        if find_spec(name) is None:
            notices.append(f"{name} is not installed (`pip install thermal-twin[bench]`): its rows are left out.")
            del others[name]
    for n_times in sizes:
        model, y = problem(n_times)
        timings.append(Timing("thermal-twin", n_times, *time_ours(model, y, 1e-13)))
        timings.append(Timing("thermal-twin, gains never reused", n_times, *time_ours(model, y, -1.0)))
        for name, measure in others.items():
            timings.append(Timing(name, n_times, *measure(model, y)))
    return timings, notices


def measure_million() -> tuple[float, float]:
    """Return seconds and peak growth of memory (GiB) of filter plus smoother over 10⁶ samples, all covariances kept."""
    model, y = problem(1_000_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = perf_counter()
    smooth(model, kalman_filter(model, y))
    return perf_counter() - begin, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
