"""Undeclared heat on every node: the model of the readings that it implies, and its likelihood.

Where the declared model lacks an effect, its best open-loop trajectory can lie far from the measured one, and so do the
parameters that produce it. Here every node carries a undeclared heat (paper B, eqs. 5-10) and the heat balance is linearised
about temperatures close to the measured ones. The undeclared heat absorbs what is missing; ``fit`` fits parameters in
its presence, ``size`` tells how large it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.calibrate.problem import Problem, Segment
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.smoother import smooth
from twin_core.latent_force.held import Grid, HeldForce, grid_of
from twin_core.latent_force.whitening import affine_march
from twin_core.network.dynamics import reading_offsets_K
from twin_core.network.model import Network
from twin_core.simulate.one_step import Steps, one_step
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import Rollout

FLOOR_SHARE = 1e-3
NO_HEAT_W = 1e-9


@dataclass(frozen=True)
class UndeclaredHeat:
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
    """One segment linearised about temperatures close to the measured ones.

    ``means`` are A and B averaged over each kind of step. ``reference_K`` and ``offset_K``, (n_samples, n_sensors), are what the
    linearised model reads without undeclared heat, and what of it are sensor faults. A search keeps many of them: A and B of
    every step, by far the most of it, are computed where they are needed.
    """

    segment: Segment
    starts_K: FloatArray
    extra_W: FloatArray
    stages_K: FloatArray
    means: tuple[FloatArray, FloatArray]
    reference_K: FloatArray
    offset_K: FloatArray
    sample_of: IntArray
    grid: Grid

    @cached_property
    def is_finite(self) -> bool:
        """Whether the linearisation has not run away."""
        return bool(np.isfinite(self.reference_K).all() and np.isfinite(self.means[0]).all())

    @property
    def residual_K(self) -> FloatArray:
        """Measured minus what the linearised model reads without undeclared heat, (n_samples, n_sensors)."""
        return self.segment.measured_K - self.reference_K


@dataclass(frozen=True)
class HeatFit:
    """Parameters fitted in the presence of undeclared heat.

    Attributes
    ----------
    problem
        Network (its parameters are the prior) and telemetry.
    free : (n_free,)
        Fitted parameters in the solver's coordinate.
    undeclared
        Size of the undeclared heat.
    nominals
        The linearisation, one per segment.
    log_likelihood
        Of the readings.
    size_curvature : (n_nodes, n_nodes)
        That of the log-likelihood in ln of the sizes, negated, as far as their search has told it.
    """

    problem: Problem
    free: FloatArray
    undeclared: UndeclaredHeat
    nominals: tuple[Nominal, ...]
    log_likelihood: float
    size_curvature: FloatArray | None = None

    @property
    def network(self) -> Network:
        """The network at the fitted values."""
        return self.problem.network.with_values(self.values)

    @property
    def values(self) -> FloatArray:
        """Physical values, (n_parameters,)."""
        return self.problem.network.parameters.to_values(self.free)

    @property
    def log_prior(self) -> float:
        """What the priors of the parameters hold against it, in nats: at most 0."""
        parameters = self.problem.network.parameters
        return -0.5 * float((((self.free - parameters.free) / parameters.prior_std) ** 2).sum())

    @property
    def log_posterior(self) -> float:
        """Log-likelihood of the readings less what the priors of the parameters hold against them."""
        return self.log_likelihood + self.log_prior

    def unknowns(self) -> FloatArray:
        """Return the unknown vector of the trajectory problem here: parameters and smoothed initial temperatures."""
        return np.concatenate([self.free, *(n.starts_K[0] for n in self.nominals)])


def linearise(
    problem: Problem,
    values: FloatArray,
    segment: Segment,
    states_K: FloatArray,
    extra_W: FloatArray,
    near_K: FloatArray | None = None,
    grid: Grid | None = None,
) -> Nominal:
    """Return a segment linearised about states (n_steps + 1, n_nodes) and a heat (n_steps, n_nodes) that keeps them.

    ``near_K`` are stage states close by, to save iterations; ``grid`` is how the steps of the segment repeat, where known.
    """
    network, forcing = problem.network, segment.forcing
    steps = one_step(network, values, forcing, states_K[:-1], extra_W, near_K=near_K)
    sample_of = np.full(forcing.n_steps + 1, -1, dtype=np.int64)
    sample_of[forcing.sample_step] = np.arange(forcing.sample_step.size)
    grid = grid or grid_of(forcing.step_s, sample_of, segment.valid)
    means = grid.means_of(steps)
    # Deviations from the states follow the mean A and B here as in the covariance of the readings. A of every step depends on
    # states that were inferred from the readings: a reference far from them would seem to predict them.
    transition, response = means[0][grid.kind], means[1][grid.kind]
    pushed = steps.ends_K - states_K[1:] - np.einsum("kij,kj->ki", response, extra_W)
    reference = states_K + affine_march(transition, pushed, segment.start_prior_K - states_K[0])
    offset_K = reading_offsets_K(network, values, segment.record.clock_s)
    read = reference[forcing.sample_step][:, network.sensor_node] + offset_K
    return Nominal(segment, states_K[:-1], extra_W, steps.stages_K, means, read, offset_K, sample_of, grid)


def floor_K2(problem: Problem) -> FloatArray:
    """Return the variance per step that keeps the filter awake, (n_nodes,)."""
    return np.full(problem.n_nodes, (FLOOR_SHARE * float(np.median(problem.noise_K))) ** 2)


def held_force(problem: Problem, undeclared: UndeclaredHeat, nominal: Nominal) -> HeldForce:
    """Return the model of temperatures and undeclared heats of a segment."""
    return HeldForce(
        step_s=nominal.segment.forcing.step_s,
        std_W=undeclared.std_W,
        length_s=undeclared.length_s,
        floor_K2=floor_K2(problem),
        sensor_node=problem.network.sensor_node,
        noise_K=problem.noise_K,
        start_std_K=nominal.segment.start_std_K,
    )


def whiten(
    problem: Problem, undeclared: UndeclaredHeat, nominal: Nominal, columns: FloatArray
) -> tuple[FloatArray, float]:
    """Return columns (n_samples, n_sensors, n_columns) in the metric of the readings, and ln det of their covariance."""
    force = held_force(problem, undeclared, nominal)
    return force.whiten(columns, nominal.means, nominal.sample_of, nominal.segment.valid, nominal.grid)


def log_likelihood(problem: Problem, undeclared: UndeclaredHeat, nominals: Sequence[Nominal]) -> float:
    """Return the log-likelihood of the readings of all segments; minus infinity where the linearisation ran away."""
    total = 0.0
    for nominal in nominals:
        if not nominal.is_finite:
            return -np.inf
        whitened, log_det = whiten(problem, undeclared, nominal, nominal.residual_K[:, :, None])
        count = int(nominal.segment.valid.sum())
        with np.errstate(over="ignore", invalid="ignore"):  # a linearisation that ran away is as unlikely as can be
            total -= 0.5 * (float((whitened**2).sum()) + log_det + count * np.log(2.0 * np.pi))
    return total if np.isfinite(total) else -np.inf


def log_likelihood_and_slope(
    problem: Problem, undeclared: UndeclaredHeat, nominals: Sequence[Nominal]
) -> tuple[float, FloatArray]:
    """Return the log-likelihood of all segments, and its slope in ln of the size on each node, (n_nodes,).

    Minus infinity, and no slope, where the linearisation ran away.
    """
    total, slope = 0.0, np.zeros(problem.n_nodes)
    for nominal in nominals:
        if not nominal.is_finite:
            return -np.inf, np.zeros(problem.n_nodes)
        force, valid = held_force(problem, undeclared, nominal), nominal.segment.valid
        with np.errstate(over="ignore", invalid="ignore"):
            value, part = force.score(nominal.residual_K, nominal.means, nominal.sample_of, valid, nominal.grid)
        total += value - 0.5 * int(valid.sum()) * np.log(2.0 * np.pi)
        slope += part
    return (total, slope) if np.isfinite(total) else (-np.inf, np.zeros(problem.n_nodes))


def gain_of_undeclared_heat(fit: HeatFit) -> float:
    """Return the log-likelihood that undeclared heat adds to a fit, in nats: next to nothing where nothing is missing."""
    none = UndeclaredHeat(np.full_like(fit.undeclared.std_W, NO_HEAT_W), fit.undeclared.length_s)
    return fit.log_likelihood - log_likelihood(fit.problem, none, fit.nominals)


def parameter_columns(
    problem: Problem, values: FloatArray, nominal: Nominal, *, with_residual: bool = False
) -> FloatArray:
    """Return the linear response of the readings to the free parameters, (n_samples, n_sensors, n_free).

    The undeclared heat counts as a rate of temperature: it moves with the capacities (see :func:`with_capacities`). The
    residual may follow as one more column.
    """
    network, forcing = problem.network, nominal.segment.forcing
    path = Rollout(nominal.stages_K, nominal.starts_K[0], True)
    still = np.zeros((problem.n_nodes, problem.n_free))
    shape = (forcing.sample_step.size, network.sensor_node.size)
    columns = np.empty((*shape, problem.n_free + with_residual))
    for samples, part in sensitivities(network, values, forcing, path, still, network.sensor_node):
        columns[samples, :, : problem.n_free] = part
    problem.with_reading_derivatives(values, nominal.segment, columns[:, :, : problem.n_free])
    if with_residual:
        columns[:, :, -1] = nominal.residual_K
    return columns


def smoothed_states(
    problem: Problem, values: FloatArray, undeclared: UndeclaredHeat, nominal: Nominal
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return smoothed temperatures (n_steps + 1, n_nodes), undeclared heat (n_steps + 1, n_nodes) and its deviation in W."""
    n, forcing = problem.n_nodes, nominal.segment.forcing
    starts_K, extra_W = nominal.starts_K, nominal.extra_W
    steps = one_step(problem.network, values, forcing, starts_K, extra_W, near_K=nominal.stages_K)
    drift = _drift_K(steps, starts_K, extra_W)
    model = held_force(problem, undeclared, nominal).linear_model(steps, drift, nominal.segment.start_prior_K)
    stretched = np.full((forcing.n_steps + 1, problem.network.sensor_node.size), np.nan)
    stretched[forcing.sample_step] = nominal.segment.measured_K - nominal.offset_K
    smoothed = smooth(model, kalman_filter(model, stretched, keep="states"))
    return smoothed.mean[:, :n], smoothed.mean[:, n:], np.sqrt(np.maximum(smoothed.variance[:, n:], 0.0))


def _drift_K(steps: Steps, starts_K: FloatArray, extra_W: FloatArray) -> FloatArray:
    """Return what a step adds beyond its linear answer to the start and to undeclared heat, (n_steps, n_nodes)."""
    pushed = np.einsum("kij,kj->ki", steps.heat_response_K_per_W, extra_W)
    return np.asarray(steps.ends_K - pushed - np.einsum("kij,kj->ki", steps.transition, starts_K))


def states_of(nominal: Nominal) -> FloatArray:
    """Return the temperatures at every grid point, (n_steps + 1, n_nodes)."""
    return np.vstack([nominal.starts_K, nominal.stages_K[-1:, 1]])
