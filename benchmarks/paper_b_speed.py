"""Filter plus smoother beside dynamax (jit, warmed up) and statsmodels: same likelihood, seconds, and memory at 10⁶.

All get the same six-state model (three blocks and their forces), three sensors, the same samples, and return smoothed
means and covariances. On a regular record we and statsmodels reuse gains that have settled; on an irregular one every step
has matrices of its own and nobody can. Where a library is not installed a line says so.
"""

import resource
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from time import process_time

import numpy as np

from benchmarks.paper_b_simulated import PAPER_KERNEL, force_model
from twin_core._typing import FloatArray
from twin_core.gp.discretise import discretise
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.smoother import smooth
from twin_core.gp.state_space import LinearModel
from twin_core.latent_force.augment import augment

VALUES = np.array([3.8, 500.0])
REPEATS = 5


@dataclass(frozen=True)
class Timing:
    """One library on one record: best processor time of several runs, and its log-likelihood."""

    library: str
    sampling: str
    n_times: int
    seconds: float
    log_likelihood: float


def problem(n_times: int, *, irregular: bool = False) -> tuple[LinearModel, FloatArray]:
    """Return the six-state model and a record drawn from it, sampled every second or every half to one and a half."""
    forces = force_model(PAPER_KERNEL)
    network = forces.network(np.zeros(0))
    feedback, diffusion = augment(network, forces.forces, forces.blocks(VALUES), forces.drift_K2_per_s)
    rng = np.random.default_rng(0)
    step_s = rng.uniform(0.5, 1.5, n_times - 1) if irregular else np.ones(1)
    discrete = discretise(np.real(feedback), np.real(diffusion), step_s)
    a, q = np.real(discrete.transition), np.real(discrete.process_cov)
    short = forces.linear_model(VALUES)
    model = LinearModel.build(
        transition=a,
        process_cov=q,
        offset=np.broadcast_to(
            np.real(discrete.hold)[:, :, :3] @ np.real(network.constant_K_per_s[-1, 0]), (n_times - 1, 6)
        ),
        observation=short.observation,
        noise_variance=short.noise_variance,
        prior_mean=short.prior_mean,
        prior_cov=short.prior_cov,
        n_times=n_times,
    )
    roots = np.linalg.cholesky(q + 1e-18 * np.eye(6))
    x, shocks = short.prior_mean.copy(), rng.normal(size=(n_times, 6))
    y = np.empty((n_times, 3))
    y[0] = x[:3]
    for k, d in enumerate(model.step_index):
        x = a[d] @ x + model.offset[k] + roots[d] @ shocks[k]
        y[k + 1] = x[:3]
    return model, y + np.sqrt(short.noise_variance) * rng.normal(size=y.shape)


def _few(rows: FloatArray) -> FloatArray:
    """Return one row where all are alike."""
    return rows[:1] if (rows == rows[0]).all() else rows


def _each(stack: FloatArray, *, into: bool) -> FloatArray:
    """Return one matrix where all steps share it, else one per sample: of the step into it, or out of it."""
    ends = (stack[:1], stack) if into else (stack, stack[-1:])
    return stack[0] if stack.shape[0] == 1 else np.concatenate(ends)


def _best(call: Callable[[], float]) -> tuple[float, float]:
    """Run once to warm up, then return the best processor time of several runs, and the last log-likelihood."""
    total, seconds = call(), []
    for _ in range(REPEATS):
        begin = process_time()
        total = call()
        seconds.append(process_time() - begin)
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
        dynamics_weights=jnp.asarray(_each(model.transition, into=True)),
        dynamics_bias=jnp.asarray(_each(_few(model.offset), into=True)),
        dynamics_covariance=jnp.asarray(_each(model.process_cov, into=True)),
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
    a, q, b = (_each(stack, into=False) for stack in (model.transition, model.process_cov, _few(model.offset)))
    engine["transition"], engine["state_cov"] = (np.asfortranarray(m.T.swapaxes(0, 1)) for m in (a, q))
    engine["selection"], engine["design"] = np.eye(6), model.observation
    engine["obs_cov"] = np.diag(model.noise_variance)
    engine["state_intercept"] = np.asfortranarray(b.T if b.ndim == 2 else b[:, None])
    engine.initialize_known(model.prior_mean, model.prior_cov)

    def call() -> float:
        return float(engine.smooth(smoother_output=SMOOTHER_STATE | SMOOTHER_STATE_COV).llf)

    return _best(call)


OTHERS: dict[str, Callable[[LinearModel, FloatArray], tuple[float, float]]] = {
    "dynamax": time_dynamax,
    "statsmodels": time_statsmodels,
}


def compare(sizes: tuple[int, ...]) -> tuple[list[Timing], list[str]]:
    """Time every installed library at every size and sampling; also return a line for each that is missing."""
    timings, notices = [], []
    others = dict(OTHERS)
    for name in list(others):
        if find_spec(name) is None:
            notices.append(f"{name} is not installed (`pip install thermal-twin[bench]`): its rows are left out.")
            del others[name]
    for sampling in ("regular", "irregular"):
        for n_times in sizes:
            model, y = problem(n_times, irregular=sampling == "irregular")
            timings.append(Timing("thermal-twin", sampling, n_times, *time_ours(model, y, 1e-13)))
            if sampling == "regular":
                timings.append(
                    Timing("thermal-twin, gains never reused", sampling, n_times, *time_ours(model, y, -1.0))
                )
            for name, measure in others.items():
                timings.append(Timing(name, sampling, n_times, *measure(model, y)))
    return timings, notices


def measure_million() -> tuple[float, float]:
    """Return processor seconds and peak growth of memory (GiB) of filter plus smoother over 10⁶ samples, all covariances kept."""
    model, y = problem(1_000_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = process_time()
    smooth(model, kalman_filter(model, y))
    return process_time() - begin, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
