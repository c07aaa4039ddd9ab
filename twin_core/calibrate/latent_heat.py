"""Calibration in the presence of undeclared heat: prediction errors instead of trajectories.

Where the declared model lacks an effect, its best open-loop trajectory can lie far from the measured one, and so do the
parameters that produce it. Here every node carries a latent heat (paper B, eqs. 5-10), the heat balance is linearised
about the smoothed measured temperatures, and the parameters follow by generalised least squares on the innovations. The
latent heat absorbs what is missing, so that the parameters stay where the physics is; its size and its evidence tell how
much is missing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import FloatArray
from twin_core.calibrate.problem import Problem, Segment
from twin_core.calibrate.starting import filled_columns
from twin_core.calibrate.whitening import affine_march, whiten_columns
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.smoother import smooth
from twin_core.gp.state_space import LinearModel
from twin_core.network.model import Network
from twin_core.simulate.kernels import GAMMA, march_sensitivities
from twin_core.simulate.one_step import Steps, one_step
from twin_core.simulate.rollout import balance_along

LENGTH_SHARES = (0.004, 0.02, 0.08)
"""Correlation lengths of the latent heat that are compared, as shares of the longest segment."""

FLOOR_SHARE = 1e-3
LONGEST_SHARE = 0.1
"""The latent heat's correlation length is at most this share of the record, so that lasting heat stays improbable."""

LEASHES = (0.2, 0.2, 0.3, 0.3, 0.5, 1.0)
START_SHARES = (1.0, 0.03)
SMALLEST_LOG_STEP, SETTLED_LOG_STEP, LARGEST_LOG_STEP = 0.1, 0.3, 2.5
SETTLED_NATS = 0.2
"""A pass that adds less than this to the log-likelihood is the last."""
COLUMNS_AT_ONCE = 192


@dataclass(frozen=True)
class LatentHeat:
    """Size of the undeclared heat.

    Attributes
    ----------
    std_W : (n_nodes,)
        Stationary standard deviation on each node.
    length_s
        Correlation length, shared.
    """

    std_W: FloatArray
    length_s: float


@dataclass(frozen=True)
class Nominal:
    """One segment linearised about temperatures close to the measured ones."""

    segment: Segment
    starts_K: FloatArray
    extra_W: FloatArray
    steps: Steps
    reference_K: FloatArray
    sample_of: np.ndarray

    @property
    def residual_K(self) -> FloatArray:
        """Measured minus what the linearised model reads without undeclared heat, (n_samples, n_sensors)."""
        return self.segment.measured_K - self.reference_K


@dataclass(frozen=True)
class HeatFit:
    """Parameters fitted in the presence of latent heat.

    Attributes
    ----------
    problem
        Network (its parameters are the prior) and telemetry.
    free : (n_free,)
        Fitted parameters in the solver's coordinate.
    latent
        Size of the undeclared heat.
    nominals
        The linearisation, one per segment.
    log_likelihood
        Of the readings.
    """

    problem: Problem
    free: FloatArray
    latent: LatentHeat
    nominals: tuple[Nominal, ...]
    log_likelihood: float

    @property
    def network(self) -> Network:
        """The network at the fitted values."""
        return self.problem.network.with_values(self.values)

    @property
    def values(self) -> FloatArray:
        """Physical values, (n_parameters,)."""
        return self.problem.network.parameters.to_values(self.free)

    @property
    def log_posterior(self) -> float:
        """Log-likelihood of the readings less what the priors of the parameters hold against them."""
        parameters = self.problem.network.parameters
        return self.log_likelihood - 0.5 * float((((self.free - parameters.free) / parameters.prior_std) ** 2).sum())

    def unknowns(self) -> FloatArray:
        """Return the unknown vector of the trajectory problem here: parameters and smoothed initial temperatures."""
        return np.concatenate([self.free, *(n.starts_K[0] for n in self.nominals)])


def _first_guess(problem: Problem, segment: Segment) -> FloatArray:
    """Return temperatures at every grid point, (n_steps + 1, n_nodes), interpolated from the readings."""
    network, at = problem.network, segment.forcing.sample_step
    filled = filled_columns(network, segment.record.time_s, segment.measured_K, None)
    grid = np.arange(segment.forcing.n_steps + 1)
    return np.stack([np.interp(grid, at, column) for column in filled.T], axis=1)


def linearise(
    problem: Problem,
    values: FloatArray,
    segment: Segment,
    states_K: FloatArray,
    extra_W: FloatArray,
    near_K: FloatArray | None = None,
) -> Nominal:
    """Return a segment linearised about states (n_steps + 1, n_nodes) and a heat (n_steps, n_nodes) that keeps them.

    ``near_K`` are stage states close by, to save iterations.
    """
    network, forcing = problem.network, segment.forcing
    steps = one_step(network, values, forcing, states_K[:-1], extra_W, near_K=near_K)
    pushed = np.einsum("kij,kj->ki", steps.heat_response_K_per_W, extra_W)
    offset = steps.ends_K - pushed - np.einsum("kij,kj->ki", steps.transition, states_K[:-1])
    reference = affine_march(steps.transition, offset, segment.start_prior_K)
    sample_of = np.full(forcing.n_steps + 1, -1, dtype=np.int64)
    sample_of[forcing.sample_step] = np.arange(forcing.sample_step.size)
    read = reference[forcing.sample_step][:, network.sensor_node]
    for term in network.readings:
        part = term.evaluate(segment.record.time_s, values[network.term_index(term)])
        read[:, part.sensor] += part.offset_K
    return Nominal(segment, states_K[:-1], extra_W, steps, read, sample_of)


def floor_K2(problem: Problem) -> FloatArray:
    """Return the variance per step that keeps the filter awake, (n_nodes,)."""
    return np.full(problem.n_nodes, (FLOOR_SHARE * float(np.median(problem.noise_K))) ** 2)


def whiten(problem: Problem, latent: LatentHeat, nominal: Nominal, columns: FloatArray) -> tuple[FloatArray, float]:
    """Return columns (n_samples, n_sensors, n_columns) in the metric of the readings, and ln det of their covariance."""
    keep = np.exp(-nominal.segment.forcing.step_s / latent.length_s)
    parts, log_det = [], 0.0
    for first in range(0, max(columns.shape[2], 1), COLUMNS_AT_ONCE):
        whitened, log_det = whiten_columns(
            nominal.steps.transition,
            nominal.steps.heat_response_K_per_W,
            keep,
            latent.std_W**2,
            floor_K2(problem),
            problem.network.sensor_node,
            problem.noise_K**2,
            nominal.segment.start_std_K**2,
            nominal.sample_of,
            nominal.segment.valid,
            np.ascontiguousarray(np.nan_to_num(columns[:, :, first : first + COLUMNS_AT_ONCE])),
        )
        parts.append(whitened)
    return np.concatenate(parts, axis=2), log_det


def log_likelihood(problem: Problem, latent: LatentHeat, nominals: Sequence[Nominal]) -> float:
    """Return the log-likelihood of the readings of all segments."""
    total = 0.0
    for nominal in nominals:
        whitened, log_det = whiten(problem, latent, nominal, nominal.residual_K[:, :, None])
        count = int(nominal.segment.valid.sum())
        total -= 0.5 * (float((whitened**2).sum()) + log_det + count * np.log(2.0 * np.pi))
    return total


def parameter_columns(problem: Problem, values: FloatArray, nominal: Nominal) -> FloatArray:
    """Return the linear response of the readings to the free parameters, (n_samples, n_sensors, n_free).

    The undeclared heat counts as a rate of temperature: it moves with the capacities (see :func:`with_capacities`).
    """
    network, forcing = problem.network, nominal.segment.forcing
    stages = nominal.steps.stages_K
    balance = balance_along(network, values, forcing, stages, 0, forcing.n_steps, derivatives=True)
    n, jacobian = problem.n_nodes, balance.jacobian_per_s
    if network.capacities:
        heated = balance_along(network, values, forcing, stages, 0, forcing.n_steps, extra_W=nominal.extra_W)
        jacobian = heated.jacobian_per_s
    block, _ = march_sensitivities(
        forcing.step_s,
        jacobian.reshape(-1, 2, n, n),
        balance.entry_free,
        balance.entry_node,
        balance.entry_series.reshape(balance.entry_free.size, forcing.n_steps, 2),
        np.zeros((n, problem.n_free)),
        forcing.sample_step,
        network.sensor_node,
        GAMMA,
    )
    return problem.with_reading_derivatives(values, nominal.segment, block)


def smoothed_states(
    problem: Problem, latent: LatentHeat, nominal: Nominal
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return smoothed temperatures (n_steps + 1, n_nodes), latent heat (n_steps + 1, n_nodes) and its deviation in W."""
    n, forcing = problem.n_nodes, nominal.segment.forcing
    model = _augmented(problem, latent, nominal)
    stretched = np.full((forcing.n_steps + 1, problem.network.sensor_node.size), np.nan)
    read = nominal.segment.measured_K.copy()
    for term in problem.network.readings:
        part = term.evaluate(
            nominal.segment.record.time_s, problem.network.parameters.values[problem.network.term_index(term)]
        )
        read[:, part.sensor] -= part.offset_K
    stretched[forcing.sample_step] = read
    smoothed = smooth(model, kalman_filter(model, stretched, keep="states"))
    return smoothed.mean[:, :n], smoothed.mean[:, n:], np.sqrt(np.maximum(smoothed.variance[:, n:], 0.0))


def _augmented(problem: Problem, latent: LatentHeat, nominal: Nominal) -> LinearModel:
    """Return the model of temperatures and latent heats, [T, q], of a segment."""
    n, steps, forcing = problem.n_nodes, nominal.steps, nominal.segment.forcing
    keep = np.exp(-forcing.step_s / latent.length_s)
    transition = np.zeros((forcing.n_steps, 2 * n, 2 * n))
    transition[:, :n, :n] = steps.transition
    transition[:, :n, n:] = steps.heat_response_K_per_W
    transition[:, np.arange(n, 2 * n), np.arange(n, 2 * n)] = keep[:, None]
    process = np.zeros_like(transition)
    process[:, np.arange(n), np.arange(n)] = floor_K2(problem)
    process[:, np.arange(n, 2 * n), np.arange(n, 2 * n)] = (1.0 - keep**2)[:, None] * latent.std_W**2
    offset = np.zeros((forcing.n_steps, 2 * n))
    offset[:, :n] = (
        steps.ends_K
        - np.einsum("kij,kj->ki", steps.heat_response_K_per_W, nominal.extra_W)
        - np.einsum("kij,kj->ki", steps.transition, nominal.starts_K)
    )
    observation = np.zeros((problem.noise_K.size, 2 * n))
    observation[np.arange(problem.noise_K.size), problem.network.sensor_node] = 1.0
    return LinearModel.build(
        transition=transition,
        process_cov=process,
        offset=offset,
        observation=observation,
        noise_variance=problem.noise_K**2,
        prior_mean=np.concatenate([nominal.segment.start_prior_K, np.zeros(n)]),
        prior_cov=np.diag(np.concatenate([nominal.segment.start_std_K**2, latent.std_W**2])),
        n_times=forcing.n_steps + 1,
    )


def _smoothing_pass(
    problem: Problem, values: FloatArray, latent: LatentHeat, nominals: Sequence[Nominal]
) -> tuple[Nominal, ...]:
    """Relinearise every segment about its smoothed temperatures and heat."""
    fresh = []
    for nominal in nominals:
        states, heat, _ = smoothed_states(problem, latent, nominal)
        fresh.append(linearise(problem, values, nominal.segment, states, heat[:-1]))
    return tuple(fresh)


def _relinearised(problem: Problem, values: FloatArray, nominals: Sequence[Nominal]) -> tuple[Nominal, ...]:
    """Linearise every segment at other parameter values about the same temperatures and heat."""
    return tuple(linearise(problem, values, n.segment, _states(n), n.extra_W, n.steps.stages_K) for n in nominals)


def _states(nominal: Nominal) -> FloatArray:
    """Return the temperatures at every grid point, (n_steps + 1, n_nodes)."""
    return np.vstack([nominal.starts_K, nominal.steps.ends_K[-1:]])


def gauss_newton_step(
    problem: Problem, free: FloatArray, latent: LatentHeat, nominals: Sequence[Nominal], leash: float = np.inf
) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton step of the free parameters, (n_free,), and the Hessian, (n_free, n_free).

    ``leash`` shortens the priors of logarithmic parameters for the early passes, in which the latent heat is still so
    large that it could take over what conductances do.
    """
    parameters = problem.network.parameters
    values = parameters.to_values(free)
    std = leashed(problem, leash)
    hessian = np.diag(1.0 / std**2)
    gradient = (free - parameters.free) / std**2
    for nominal in nominals:
        columns = np.concatenate([parameter_columns(problem, values, nominal), nominal.residual_K[:, :, None]], axis=2)
        whitened, _ = whiten(problem, latent, nominal, columns)
        flat = whitened.reshape(-1, columns.shape[2])
        hessian += flat[:, :-1].T @ flat[:, :-1]
        gradient -= flat[:, :-1].T @ flat[:, -1]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-30))
    damped = hessian * scale[:, None] * scale + 1e-6 * np.eye(scale.size)
    return -scale * np.linalg.solve(damped, scale * gradient), hessian


def leashed(problem: Problem, leash: float) -> FloatArray:
    """Return prior deviations with those of logarithmic parameters no longer than a leash."""
    std = problem.network.parameters.prior_std.copy()
    std[problem.logarithmic] = np.minimum(std[problem.logarithmic], leash)
    return std


@dataclass
class SizeSearch:
    """A pattern search of the latent heat's size, whose steps shrink from pass to pass.

    Attributes
    ----------
    log_step : (n_nodes + 1,)
        Next change to be tried, in ln: of the size on each node, and of the correlation length.
    """

    log_step: FloatArray

    def improve(self, problem: Problem, latent: LatentHeat, nominals: Sequence[Nominal]) -> tuple[LatentHeat, float]:
        """Return a more likely size of the latent heat on each node, and its log-likelihood."""
        best, value = latent, log_likelihood(problem, latent, nominals)
        for position in range(problem.n_nodes + 1):
            moved = False
            for sign in (-1.0, 1.0):
                trial = self._changed(best, position, sign, nominals)
                found = log_likelihood(problem, trial, nominals)
                if found > value:
                    best, value, moved = trial, found, True
                    break
            self.log_step[position] *= 1.4 if moved else 0.5
        self.log_step = np.clip(self.log_step, SMALLEST_LOG_STEP, LARGEST_LOG_STEP)
        return best, value

    def _changed(self, latent: LatentHeat, position: int, sign: float, nominals: Sequence[Nominal]) -> LatentHeat:
        factor = float(np.exp(sign * self.log_step[position]))
        if position == latent.std_W.size:
            shortest = float(np.median(nominals[0].segment.forcing.step_s))
            length = np.clip(latent.length_s * factor, shortest, LONGEST_SHARE * span_s(nominals))
            return replace(latent, length_s=float(length))
        std = latent.std_W.copy()
        std[position] *= factor
        return replace(latent, std_W=std)


def span_s(nominals: Sequence[Nominal]) -> float:
    """Return the length of the longest segment."""
    return max(float(n.segment.record.time_s[-1] - n.segment.record.time_s[0]) for n in nominals)


def new_search(n_nodes: int, log_step: float) -> SizeSearch:
    """Return a search whose first steps are ``log_step``; that of the length is gentler."""
    return SizeSearch(np.append(np.full(n_nodes, log_step), 0.7))


def first_size(problem: Problem, nominals: Sequence[Nominal]) -> LatentHeat:
    """Return a starting size: the heat that the linearised model lacks from sample to sample, and the best length."""
    span = span_s(nominals)
    values = problem.network.parameters.values
    capacity = values[problem.network.capacity_index]
    swing = np.array([np.nanstd(n.starts_K, axis=0) for n in nominals]).max(axis=0)
    typical = 0.3 * capacity * np.maximum(swing, 0.1) / (0.02 * span)
    options = [LatentHeat(typical, share * span) for share in LENGTH_SHARES]
    scored = [(fit_common(problem, option, nominals)) for option in options]
    return max(scored, key=lambda item: item[1])[0]


def fit_common(problem: Problem, latent: LatentHeat, nominals: Sequence[Nominal]) -> tuple[LatentHeat, float]:
    """Return the best common factor of the latent heat, and its likelihood."""
    trials = [replace(latent, std_W=latent.std_W * f) for f in (10.0, 2.0, 0.4, 0.08, 0.016)]
    return max(((t, log_likelihood(problem, t, nominals)) for t in trials), key=lambda item: item[1])


def fit_with_latent_heat(
    problem: Problem,
    free: FloatArray | None = None,
    *,
    near: HeatFit | None = None,
    n_passes: int = 12,
    leashes: Sequence[float] = LEASHES,
) -> HeatFit:
    """Fit the free parameters in the presence of latent heat.

    Parameters
    ----------
    problem
        Network and telemetry; its parameters are the prior.
    free : (n_free,)
        Where to start; the problem's own parameters by default.
    near
        A fit of the same telemetry from which temperatures and latent heat start.
    n_passes
        Passes at most, of a Gauss-Newton step and sizing; fewer where the likelihood no longer grows.
    leashes
        Prior deviations of logarithmic parameters in the first passes, each about newly smoothed temperatures.

    Returns
    -------
    HeatFit
    """
    parameters = problem.network.parameters
    free = parameters.free.copy() if free is None else free.copy()
    values = parameters.to_values(free)
    if near is not None:
        nominals, latent = _carried_over(problem, values, near)
        sizes = new_search(problem.n_nodes, 1.5)
        return _settle(HeatFit(problem, free, latent, nominals, -np.inf), sizes, n_passes)
    first = tuple(
        linearise(problem, values, s, _first_guess(problem, s), np.zeros((s.forcing.n_steps, problem.n_nodes)))
        for s in problem.segments
    )
    typical = first_size(problem, first)
    started = []
    for share in START_SHARES:
        fit = HeatFit(problem, free, replace(typical, std_W=share * typical.std_W), first, -np.inf)
        sizes = new_search(problem.n_nodes, LARGEST_LOG_STEP)
        for leash in leashes:
            fit = _pass(fit, sizes, leash, smoothing=True)
        started.append((fit, sizes))
    fit, sizes = max(started, key=lambda item: item[0].log_posterior)
    return _settle(fit, sizes, n_passes)


def _settle(fit: HeatFit, sizes: SizeSearch, n_passes: int) -> HeatFit:
    """Take passes until the likelihood no longer grows."""
    for _ in range(n_passes):
        before = fit.log_likelihood
        fit = _pass(fit, sizes, np.inf)
        if fit.log_likelihood - before < SETTLED_NATS and (sizes.log_step < SETTLED_LOG_STEP).all():
            break
    return fit


def _pass(fit: HeatFit, sizes: SizeSearch, leash: float, *, smoothing: bool = False) -> HeatFit:
    """Relinearise about smoothed temperatures where asked, then improve parameters, then the latent heat's size."""
    problem, nominals = fit.problem, fit.nominals
    if smoothing:
        nominals = _smoothing_pass(problem, fit.values, fit.latent, nominals)
    free, latent, nominals = _improve(problem, fit.free, fit.latent, nominals, leash)
    latent, value = sizes.improve(problem, latent, nominals)
    return HeatFit(problem, free, latent, nominals, value)


def with_capacities(problem: Problem, latent: LatentHeat, before: FloatArray, after: FloatArray) -> LatentHeat:
    """Return the latent heat that makes the same rates of temperature at other parameter values.

    Telemetry tells how fast temperatures move, not by how many watts. A size held in watts would make the likelihood of
    a capacity depend on the size more than on the heat balance, which a Gauss-Newton step does not see.
    """
    index = problem.network.capacity_index
    return replace(latent, std_W=latent.std_W * after[index] / before[index])


def _improve(
    problem: Problem, free: FloatArray, latent: LatentHeat, nominals: Sequence[Nominal], leash: float
) -> tuple[FloatArray, LatentHeat, tuple[Nominal, ...]]:
    """Take one Gauss-Newton step, shortened until the likelihood (with priors) does not fall."""
    parameters, std = problem.network.parameters, leashed(problem, leash)
    now = parameters.to_values(free)

    def posterior(at: FloatArray, size: LatentHeat, about: Sequence[Nominal]) -> float:
        return log_likelihood(problem, size, about) - 0.5 * float((((at - parameters.free) / std) ** 2).sum())

    before = posterior(free, latent, nominals)
    step, _ = gauss_newton_step(problem, free, latent, nominals, leash)
    logarithmic = problem.logarithmic
    step *= min(1.0, 1.5 / max(np.abs(step[logarithmic]).max(initial=0.0), 1e-12))
    for _ in range(5):
        trial = free + step
        values = parameters.to_values(trial)
        size, about = with_capacities(problem, latent, now, values), _relinearised(problem, values, nominals)
        if posterior(trial, size, about) > before:
            return trial, size, about
        step = 0.35 * step
    return free, latent, tuple(nominals)


def _carried_over(problem: Problem, values: FloatArray, near: HeatFit) -> tuple[tuple[Nominal, ...], LatentHeat]:
    """Linearise a network that may have more states about the temperatures and heat of a fit close by."""
    network, before = problem.network, near.problem.network
    like = {extra.name: extra.like for extra in network.extra}
    source = [before.nodes.index(n if n in before.nodes else like[n]) for n in network.nodes]
    own = np.array([n in before.nodes for n in network.nodes])
    fresh = []
    for nominal, segment in zip(near.nominals, problem.segments, strict=True):
        states = _states(nominal)[:, source]
        fresh.append(linearise(problem, values, segment, states, np.where(own, nominal.extra_W[:, source], 0.0)))
    std = np.where(own, near.latent.std_W[source], 1e-6)
    return tuple(fresh), LatentHeat(std, near.latent.length_s)
