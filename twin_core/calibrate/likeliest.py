"""Trajectories at their greatest likelihood under the coloured noise of what they leave.

Least squares in the sensors' own noise follow a misfit that lasts as if it were signal; the likelihood of their residuals under
an Ornstein-Uhlenbeck process lies below its maximum then, by hundreds of nats where a lumped network is coarse. From there steps
of generalised least squares take turns with the noise (Cochrane and Orcutt 1949, Journal of the American Statistical Association
44:32), each step kept only if the likelihood rises.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve

from twin_core._typing import FloatArray
from twin_core.calibrate.containment import attempted, check_time
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Fit, Problem
from twin_core.calibrate.residual_noise import Whitener, fit_whitener, sensor_jacobians

Flows = Callable[[FloatArray, Fit], list[FloatArray]]
"""From unknowns and the model there to columns that are added to each sensor's prediction, (n_rows, n_columns) per sensor."""

MOST_STEPS = 20
"""Steps of the climb at most, a limit of time; ``python -m benchmarks.likeliest`` prints what none, half and double reach."""

SETTLED_NATS = 0.5
"""The climb ends where a step gains no more: a tenth of what the odds of one in a hundred are."""

SHORTER = (1.0, 0.3, 0.1)
"""Shares of a step that are tried until one gains, a limit of time."""


@dataclass(frozen=True)
class _Point:
    unknowns: FloatArray
    fit: Fit
    amounts: FloatArray
    columns: list[FloatArray]
    left_K: FloatArray
    whitener: Whitener
    log_posterior: float


def greatest_log_posterior(
    problem: Problem,
    optimum: Optimum,
    whitener: Whitener,
    columns: Flows | None = None,
    amounts: FloatArray | None = None,
    spread: float = 1.0,
) -> float:
    """Return the greatest log-likelihood of trajectories under their own coloured noise, less what priors hold against them.

    Initial temperatures are fitted: each pays its Schwarz penalty, so that the value stands beside likelihoods that are averaged
    over them. Amounts of the columns are averaged over.

    Parameters
    ----------
    problem, optimum
        A network fitted to open-loop trajectories, where the climb starts.
    whitener
        The noise of what is left there.
    columns
        What may be added to the predictions of each sensor.
    amounts
        How much of each column, at the start.
    spread
        Standard deviation of every amount before anything is measured.

    Returns
    -------
    float
        In nats. Where arithmetic fails on the way, what was reached by then.
    """
    mean, std = problem.prior()
    ends = np.cumsum([segment.record.time_s.size for segment in problem.segments])[:-1]
    n_rows, n_sensors = sum(s.record.time_s.size for s in problem.segments), problem.network.sensor_node.size
    n_starts = problem.n_unknowns - problem.n_free

    def at(unknowns: FloatArray, fit: Fit, amounts: FloatArray, near: Whitener | None) -> _Point:
        added = columns(unknowns, fit) if columns is not None else [np.zeros((n_rows, 0))] * n_sensors
        left_K = np.concatenate(problem.residuals(fit))
        for sensor, (own, where) in enumerate(zip(added, of_sensor(added), strict=True)):
            left_K[:, sensor] -= own @ amounts[where]
        noise = whitener if near is None else fit_whitener(problem, np.split(left_K, ends), near)
        against = 0.5 * float((((unknowns - mean) / std) ** 2).sum() + ((amounts / spread) ** 2).sum())
        against += 0.5 * n_starts * float(np.log(problem.n_samples)) + averaged(noise, added, spread)
        return _Point(unknowns, fit, amounts, added, left_K, noise, noise.log_likelihood - against)

    def climbed(here: _Point) -> _Point:
        step, promised = _step(problem, optimum, here, mean, std, spread)
        for share in SHORTER if promised > SETTLED_NATS else ():
            unknowns = here.unknowns + share * step[: problem.n_unknowns]
            fit = problem.solve(unknowns, near=here.fit)
            if not np.isfinite(fit.cost):
                continue
            there = at(unknowns, fit, here.amounts + share * step[problem.n_unknowns :], here.whitener)
            if there.log_posterior > here.log_posterior and there.whitener.valid.sum() == here.whitener.valid.sum():
                return there
        return here

    here = at(optimum.unknowns, optimum.fit, np.zeros(0) if amounts is None else amounts, None)
    for _ in range(MOST_STEPS):
        check_time()
        there = attempted(partial(climbed, here), "trajectories at their greatest likelihood", [])
        if there is None or not there.log_posterior - here.log_posterior > SETTLED_NATS:
            return here.log_posterior if there is None else there.log_posterior
        here = there
    return here.log_posterior


def _step(
    problem: Problem, optimum: Optimum, here: _Point, mean: FloatArray, std: FloatArray, spread: float
) -> tuple[FloatArray, float]:
    """Return the step of Gauss and Newton over unknowns and amounts, each residual whitened as its own noise, and its gain.

    The gain is that of the linearised model under noise that stays as it is, in nats.
    """
    n, where = problem.n_unknowns, of_sensor(here.columns)
    hessian = block_diag(np.diag(1.0 / std**2), np.eye(here.amounts.size) / spread**2)
    gradient = np.concatenate([(here.unknowns - mean) / std**2, here.amounts / spread**2])
    for sensor, jacobian in sensor_jacobians(problem, replace(optimum, unknowns=here.unknowns, fit=here.fit)):
        all_columns = np.column_stack([jacobian, here.columns[sensor], here.left_K[:, sensor]])
        white = here.whitener.whiten(sensor, all_columns)
        own = np.r_[0:n, n + np.arange(here.amounts.size)[where[sensor]]]
        hessian[np.ix_(own, own)] += white[:, :-1].T @ white[:, :-1]
        gradient[own] -= white[:, :-1].T @ white[:, -1]
    if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
        raise ArithmeticError("the sensitivities are not finite")
    step = -solved(hessian, gradient)
    return step, -0.5 * float(gradient @ step)


def averaged(whitener: Whitener, columns: Sequence[FloatArray], spread: float) -> float:
    """Return what the mean over all amounts costs beside the likeliest: ln of the share that the readings leave (Laplace)."""
    total = 0.0
    for sensor, own in enumerate(columns):
        rows = spread * whitener.whiten(sensor, own)
        total += 0.5 * float(np.linalg.slogdet(np.eye(own.shape[1]) + rows.T @ rows)[1])
    return total


def of_sensor(columns: Sequence[FloatArray]) -> list[slice]:
    """Return where the amounts of each sensor's columns stand among all."""
    return [slice(a, b) for a, b in pairwise(np.cumsum([0, *(own.shape[1] for own in columns)]))]


def solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve positive definite equations, every unknown scaled alike; ArithmeticError where they are not."""
    if not right.size:
        return right
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    by_row = scale if right.ndim == 1 else scale[:, None]
    try:
        return np.asarray(cho_solve(cho_factor(matrix * scale[:, None] * scale), right * by_row) * by_row)
    except LinAlgError as error:
        raise ArithmeticError("the readings do not tell the unknowns apart") from error
