"""Calibration in the presence of undeclared heat: prediction errors instead of trajectories.

The parameters follow by generalised least squares on the innovations of a filter in which every node carries a undeclared heat.
They stay where the physics is, however much heat the declaration lacks.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from twin_core._typing import FloatArray
from twin_core.calibrate.bounded import bounded_step
from twin_core.calibrate.containment import NO_DEADLINE, check_time, is_late, those_that_work
from twin_core.calibrate.problem import Problem, Segment
from twin_core.calibrate.starting import filled_columns
from twin_core.calibrate.undeclared.model import (
    HeatFit,
    Nominal,
    UndeclaredHeat,
    linearise,
    log_likelihood,
    parameter_columns,
    smoothed_states,
    states_of,
    whiten,
)
from twin_core.calibrate.undeclared.size import SETTLED_NATS, SizeSearch, first_size

EARLY_PRIOR_STD = (0.2, 0.2, 0.3, 0.3, 0.5, 1.0)
"""Prior deviations of logarithmic parameters in the first passes, while the undeclared heat is still too large."""

LARGEST_STEP = 1.5
"""Longest move of a logarithmic parameter in one pass: a factor of e^1.5."""

START_SHARES = (1.0, 0.03)
"""Sizes of the undeclared heat that a fit starts from, as shares of a typical one."""

SHORTER_STEPS = (0.3, 0.1)
"""Shares of a step of the parameters that are tried in turn where the whole one is no better, a limit of time."""

MOST_REFUSED = 2
"""So many passes in which no step of the parameters helped, and only the undeclared heat is sized on."""

LEAST_GAIN_NATS = 0.02
"""A step of the parameters that promises less is not taken."""

MOST_LINEARISED = 3
"""Times that a fit is linearised about its own smoothed temperatures, a limit of time. Of 73 fits of two networks none took more;
of 140 of two measured sets 7 settled in up to 8, and 14 not even then."""

FIRST_LOG_STEP = 0.7
"""First step of the correlation length, in ln."""


def _first_guess(problem: Problem, segment: Segment) -> FloatArray:
    """Return temperatures at every grid point, (n_steps + 1, n_nodes), interpolated from the readings."""
    network, at = problem.network, segment.forcing.sample_step
    filled = filled_columns(network, segment.record.time_s, segment.measured_K, None)
    for extra in network.extra:
        if extra.follows is not None:
            filled[:, network.layout.node(extra.name)] = segment.start_prior_K[network.layout.node(extra.name)]
    grid = np.arange(segment.forcing.n_steps + 1)
    return np.stack([np.interp(grid, at, column) for column in filled.T], axis=1)


def _smoothing_pass(
    problem: Problem, values: FloatArray, undeclared: UndeclaredHeat, nominals: Sequence[Nominal]
) -> tuple[Nominal, ...]:
    """Relinearise every segment about its smoothed temperatures and heat."""
    fresh = []
    for nominal in nominals:
        states, heat, _ = smoothed_states(problem, values, undeclared, nominal)
        fresh.append(linearise(problem, values, nominal.segment, states, heat[:-1], grid=nominal.grid))
    return tuple(fresh)


def _relinearised(problem: Problem, values: FloatArray, nominals: Sequence[Nominal]) -> tuple[Nominal, ...]:
    """Linearise every segment at other parameter values about the same temperatures and heat."""
    return tuple(linearise(problem, values, n.segment, states_of(n), n.extra_W, n.stages_K, n.grid) for n in nominals)


def gauss_newton(
    problem: Problem,
    free: FloatArray,
    undeclared: UndeclaredHeat,
    nominals: Sequence[Nominal],
    most_std: float = np.inf,
) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton Hessian, (n_free, n_free), and the gradient, (n_free,), of the negative log posterior.

    ``most_std`` shortens the priors of logarithmic parameters for the early passes, in which the undeclared heat is still so
    large that it could take over what conductances do.
    """
    parameters = problem.network.parameters
    values = parameters.to_values(free)
    std = tightened_prior_std(problem, most_std)
    hessian = np.diag(1.0 / std**2)
    gradient = (free - parameters.free) / std**2
    for nominal in nominals:
        columns = parameter_columns(problem, values, nominal, with_residual=True)
        whitened, _ = whiten(problem, undeclared, nominal, columns)
        flat = whitened.reshape(-1, columns.shape[2])
        hessian += flat[:, :-1].T @ flat[:, :-1]
        gradient -= flat[:, :-1].T @ flat[:, -1]
    return hessian, gradient


def steps_to_try(problem: Problem, free: FloatArray, hessian: FloatArray, gradient: FloatArray) -> Iterator[FloatArray]:
    """Yield steps of the free parameters, to be tried in turn, (n_free,) each.

    The Gauss-Newton step holds the covariance of the readings, which depends on capacities and conductances. Where it goes too
    far, the step of all other parameters is tried: the readings are linear in most of them, and the covariance does not change.
    """
    lowest, highest = problem.step_bounds(free, LARGEST_STEP)
    step = bounded_step(_solved, hessian, gradient, lowest, highest)
    if _promised(step, hessian) < LEAST_GAIN_NATS:
        return
    yield step
    lowest[problem.logarithmic] = highest[problem.logarithmic] = 0.0
    rest = bounded_step(_solved, hessian, gradient, lowest, highest)
    if _promised(rest, hessian) > LEAST_GAIN_NATS:
        yield rest
    yield from (share * step for share in SHORTER_STEPS)


def _promised(step: FloatArray, hessian: FloatArray) -> float:
    """Return by how many nats a step makes the readings likelier, if the Hessian is right."""
    return 0.5 * float(step @ hessian @ step)


def _solved(hessian: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the Newton step, scaled so that every parameter counts alike, and hardly damped."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-30))
    damped = hessian * scale[:, None] * scale + 1e-6 * np.eye(scale.size)
    return -scale * np.linalg.solve(damped, scale * gradient)


def tightened_prior_std(problem: Problem, most_std: float) -> FloatArray:
    """Return prior deviations with those of logarithmic parameters no longer than a most_std."""
    std = problem.network.parameters.prior_std.copy()
    std[problem.logarithmic] = np.minimum(std[problem.logarithmic], most_std)
    return std


def fit_with_undeclared_heat(
    problem: Problem,
    free: FloatArray | None = None,
    *,
    near: HeatFit | None = None,
    n_passes: int = 12,
    early_prior_std: Sequence[float] = EARLY_PRIOR_STD,
    deadline: float = NO_DEADLINE,
) -> HeatFit:
    """Fit the free parameters in the presence of undeclared heat.

    Parameters
    ----------
    problem
        Network and telemetry; its parameters are the prior.
    free : (n_free,)
        Where to start; the problem's own parameters by default.
    near
        A fit of the same telemetry from which temperatures and undeclared heat start.
    n_passes
        Passes at most, of a Gauss-Newton step and sizing; fewer where the likelihood no longer grows.
    early_prior_std
        Prior deviations of logarithmic parameters in the first passes, each about newly smoothed temperatures.
    deadline
        On the clock of ``time.monotonic``: no pass but the first is begun afterwards.

    Returns
    -------
    HeatFit
    """
    parameters = problem.network.parameters
    free = parameters.free.copy() if free is None else free.copy()
    values = parameters.to_values(free)
    if near is not None:
        nominals, undeclared = _carried_over(problem, values, near)
        same = problem.n_nodes == near.problem.n_nodes
        sizes = SizeSearch(FIRST_LOG_STEP, near.size_curvature if same else None)
        return _about_itself(HeatFit(problem, free, undeclared, nominals, -np.inf), sizes, n_passes, deadline)
    first = tuple(
        linearise(problem, values, s, _first_guess(problem, s), np.zeros((s.forcing.n_steps, problem.n_nodes)))
        for s in problem.segments
    )
    typical = first_size(problem, values, first)

    def begun(share: float) -> tuple[HeatFit, SizeSearch] | None:
        if share != START_SHARES[0] and is_late(deadline):
            return None
        fit = HeatFit(problem, free, replace(typical, std_W=share * typical.std_W), first, -np.inf)
        sizes = SizeSearch(FIRST_LOG_STEP)
        for most_std in early_prior_std:
            if is_late(deadline) and np.isfinite(fit.log_likelihood):
                break
            fit = _pass(fit, sizes, most_std, smoothing=True)
        return fit, sizes

    started = [
        found for found in those_that_work([partial(begun, share) for share in START_SHARES]) if found is not None
    ]
    if not started:
        raise ArithmeticError("the first start failed, and there was no time for another")
    fit, sizes = max(started, key=lambda item: item[0].log_posterior)
    return _about_itself(fit, sizes, n_passes, deadline)


def loss_at_start(problem: Problem, free: FloatArray, near: HeatFit) -> float:
    """Return how much less likely the telemetry is where a fit would start than after the one nearby, in nats."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a start too far is as unlikely as can be
        nominals, undeclared = _carried_over(problem, problem.network.parameters.to_values(free), near)
        return near.log_likelihood - log_likelihood(problem, undeclared, nominals)


def _about_itself(fit: HeatFit, sizes: SizeSearch, n_passes: int, deadline: float) -> HeatFit:
    """Take passes until the likelihood no longer grows, and again until it is linearised about its own smoothed temperatures.

    The temperatures of another fit hold what that fit inferred from the readings: a law of a node that nobody reads, linearised
    about them, would seem to predict what it was told. Of the rounds the fit is kept whose smaller log posterior, about the
    temperatures that it was fitted to and about its own, is the greatest: one that swings is likely about one of them alone.
    """
    rounds: list[tuple[float, HeatFit]] = []
    for _ in range(MOST_LINEARISED):
        fit = _settle(fit, sizes, n_passes, deadline)
        nominals = _smoothing_pass(fit.problem, fit.values, fit.undeclared, fit.nominals)
        told, value = fit.log_likelihood, log_likelihood(fit.problem, fit.undeclared, nominals)
        value = value if np.isfinite(value) else -np.inf
        fit = replace(fit, nominals=nominals, log_likelihood=value)
        rounds.append((min(told, value) + fit.log_prior, fit))
        if value == -np.inf or abs(value - told) < SETTLED_NATS or is_late(deadline):
            break
    return max(rounds, key=lambda item: item[0])[1]


def _settle(
    fit: HeatFit,
    sizes: SizeSearch,
    n_passes: int,
    deadline: float = NO_DEADLINE,
) -> HeatFit:
    """Take passes until the likelihood no longer grows."""
    problem, refused = fit.problem, 0
    for _ in range(n_passes):
        before, free = fit.log_likelihood, fit.free
        if is_late(deadline) and np.isfinite(before):
            break
        fit = _pass(fit, sizes, np.inf, still=refused >= MOST_REFUSED)
        refused = refused + 1 if np.array_equal(free, fit.free) else 0
        if fit.log_likelihood - before < SETTLED_NATS:
            reached = fit.log_likelihood
            undeclared, value = sizes.settle_length(problem, fit.undeclared, fit.nominals, reached)
            fit = replace(fit, undeclared=undeclared, log_likelihood=value)
            if value - reached < SETTLED_NATS:
                break
    return fit


def _pass(
    fit: HeatFit,
    sizes: SizeSearch,
    most_std: float,
    *,
    smoothing: bool = False,
    still: bool = False,
) -> HeatFit:
    """Relinearise about smoothed temperatures where asked, improve parameters but for ``still``, then the heat's size."""
    check_time()
    problem = fit.problem
    if smoothing:
        fit = replace(fit, nominals=_smoothing_pass(problem, fit.values, fit.undeclared, fit.nominals))
    if smoothing or not np.isfinite(fit.log_likelihood):
        fit = replace(fit, log_likelihood=log_likelihood(problem, fit.undeclared, fit.nominals))
    free, undeclared, nominals = (fit.free, fit.undeclared, fit.nominals) if still else _improve(fit, most_std)
    undeclared, value = sizes.improve(problem, undeclared, nominals)
    return HeatFit(problem, free, undeclared, nominals, value, sizes.curvature)


def with_capacities(
    problem: Problem, undeclared: UndeclaredHeat, before: FloatArray, after: FloatArray
) -> UndeclaredHeat:
    """Return the undeclared heat that makes the same rates of temperature at other parameter values.

    Telemetry tells how fast temperatures move, not by how many watts. A size held in watts would make the likelihood of
    a capacity depend on the size more than on the heat balance, which a Gauss-Newton step does not see.
    """
    index = problem.network.capacity_index
    return replace(undeclared, std_W=undeclared.std_W * after[index] / before[index])


def _improve(fit: HeatFit, most_std: float) -> tuple[FloatArray, UndeclaredHeat, tuple[Nominal, ...]]:
    """Take the first of some steps that makes the readings likelier, with the priors; none where none does."""
    problem, free, undeclared, nominals = fit.problem, fit.free, fit.undeclared, fit.nominals
    parameters, std = problem.network.parameters, tightened_prior_std(problem, most_std)

    def log_prior(at: FloatArray) -> float:
        return -0.5 * float((((at - parameters.free) / std) ** 2).sum())

    before = fit.log_likelihood + log_prior(free)
    # A response that runs away gives no step, and a step too far is refused just below.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for step in steps_to_try(problem, free, *gauss_newton(problem, free, undeclared, nominals, most_std)):
            trial = free + step
            values = parameters.to_values(trial)
            size = with_capacities(problem, undeclared, fit.values, values)
            about = _relinearised(problem, values, nominals)
            if log_likelihood(problem, size, about) + log_prior(trial) > before:
                return trial, size, about
    return free, undeclared, nominals


def _carried_over(problem: Problem, values: FloatArray, near: HeatFit) -> tuple[tuple[Nominal, ...], UndeclaredHeat]:
    """Linearise a network that may have more states about the temperatures and heat of a fit close by."""
    network, before = problem.network, near.problem.network
    like = {extra.name: extra.like for extra in network.extra}
    source = [before.nodes.index(n if n in before.nodes else like[n]) for n in network.nodes]
    own = np.array([n in before.nodes for n in network.nodes])
    fresh = []
    for nominal, segment in zip(near.nominals, problem.segments, strict=True):
        states = states_of(nominal)[:, source]
        extra_W = np.where(own, nominal.extra_W[:, source], 0.0)
        same = np.array_equal(nominal.segment.valid, segment.valid)
        fresh.append(linearise(problem, values, segment, states, extra_W, grid=nominal.grid if same else None))
    std = np.where(own, near.undeclared.std_W[source], 1e-6)
    return tuple(fresh), UndeclaredHeat(std, near.undeclared.length_s)
