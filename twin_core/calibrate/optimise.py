"""Levenberg-Marquardt on the normal equations with geodesic acceleration; its outcome is a value, never silence.

Where several parameters together leave the readings nearly as they are, the cost is a narrow curved valley, along which straight
steps must be short. What a step bends away from its linear response corrects it (Transtrum and Sethna 2012, arXiv 1201.5885).
What single events tell, a threshold or an instant, has no second derivative: there steps are straight and small falls count.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from twin_core._typing import FloatArray
from twin_core.calibrate.bounded import bounded_step
from twin_core.calibrate.containment import NO_DEADLINE, NUMERICAL_FAILURES, check_time, is_late
from twin_core.calibrate.normal_equations import NormalEquations, normal_equations
from twin_core.calibrate.problem import Fit, Problem

Status = Literal[
    "converged",
    "stalled",
    "iteration_limit",
    "given_up",
    "early_stopping",
    "deadline",
    "numerical_failure",
    "no_solution",
]

ADVICE: dict[Status, str] = {
    "converged": "the cost no longer falls",
    "stalled": "no step lowers the cost any more: the data hardly tell some parameters apart",
    "iteration_limit": "stopped at the iteration limit while the cost still fell: start from better guesses",
    "given_up": "at the pace of its last steps the cost would not have come to what was asked for",
    "early_stopping": "the error on the validation windows no longer falls",
    "deadline": "stopped at the deadline while the cost still fell: this is the best so far, give it more time",
    "numerical_failure": "a step could not be computed, the best before it is kept: check units and known values",
    "no_solution": "the heat balance has no solution there: check the order of magnitude of loads and radiators",
}

LARGEST_STEP = 2.0
"""Longest move of a logarithmic parameter in one iteration: a factor of e^2."""

LEAST_FALL_NATS = 1e-3
"""A fall of the cost that is no news, at a misfit as large as the noise: unknowns that differ by so little are a thirtieth of
their standard deviation apart. A larger misfit makes them as much less certain."""

LEAST_GAIN = 1e-4
"""Fall of the cost over the one foretold from which a step is taken."""

STRAIGHT = 0.1
"""Where the cost falls by so little more or less than a quadratic model foretells, a step needs no correction."""

MOST_BENT = 0.75
"""Length of a correction over that of its step, in units in which every unknown counts alike, up to which it is tried: twice as
long as the second-order model of a step is trusted in (Transtrum and Sethna 2012, section 3.3). A correction is taken only where
the cost falls by more."""


PACE_STEPS, LEEWAY = 8, 4.0
"""Steps that tell the pace of a search, and how many times that pace it may take up yet. Falls come in plateaus: of 389 fits to
measured telemetry none, given up so, would have come to a tenth above its end; with 5 steps and no leeway one would have."""


@dataclass(frozen=True)
class Optimum:
    """Where the search ended.

    Attributes
    ----------
    unknowns : (n_unknowns,)
    fit
        The model there.
    hessian : (n_unknowns, n_unknowns)
        Gauss-Newton Hessian of the cost there.
    status, iterations
        Why and when it stopped; ``ADVICE`` says what to do.
    """

    unknowns: FloatArray
    fit: Fit
    hessian: FloatArray
    status: Status
    iterations: int


def _step(hessian: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    """Return the damped Newton step, scaled so that every unknown counts alike."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-30))
    scaled = hessian * scale[:, None] * scale[None, :]
    scaled[np.diag_indices_from(scaled)] += damping
    try:
        step = cho_solve(cho_factor(scaled), -gradient * scale) * scale
    except LinAlgError:
        step = -np.linalg.pinv(scaled, rcond=1e-12) @ (gradient * scale) * scale
    return step


def minimise(
    problem: Problem,
    unknowns: FloatArray | None = None,
    *,
    near: Fit | None = None,
    max_iterations: int = 60,
    tolerance: float = 1e-7,
    deadline: float = NO_DEADLINE,
    accelerated: bool = False,
    goal: float = np.inf,
) -> Optimum:
    """Minimise the cost of a problem.

    Parameters
    ----------
    problem
        What is fitted to what.
    unknowns : (n_unknowns,)
        Where to start; the problem's own start by default.
    near
        A fit close to the start, to save Newton iterations.
    max_iterations
        Accepted steps at most.
    tolerance
        Stop when an accepted step lowers the cost by less than this share, or by what ``LEAST_FALL_NATS`` says.
    deadline
        On the clock of ``time.monotonic``: no step is begun afterwards.
    accelerated
        Whether a flat valley is followed to its end, at two or three times the work of a step: for a model that is to stay, not
        for the many that a search only compares.
    goal
        Cost of the readings, priors apart, from which the result is of use: a search that would not come to it at ``LEEWAY``
        times the pace of its last ``PACE_STEPS`` is given up. It has the steps that are left, and as many again as there are,
        for what comes near is taken to its end by a second search.

    Returns
    -------
    Optimum
        With a status; a failure is a value (Madsen, Nielsen and Tingleff 2004, algorithm 3.16 for the damping).
    """
    x = problem.start() if unknowns is None else unknowns.copy()
    try:
        fit = problem.solve(x, near)
        if not np.isfinite(fit.cost):
            return Optimum(x, fit, np.eye(x.size), "no_solution", 0)
    except NUMERICAL_FAILURES:
        return Optimum(x, Fit(np.inf, (), ()), np.eye(x.size), "no_solution", 0)
    try:
        equations = normal_equations(problem, x, fit)
    except NUMERICAL_FAILURES:
        return Optimum(x, fit, np.eye(x.size), "numerical_failure", 0)
    is_smooth = not np.isfinite(problem.network.parameters.step_limits).any()
    n_readings = sum(int(segment.valid.sum()) for segment in problem.segments)
    damping, growth = 1e-3, 2.0
    status: Status = "iteration_limit"
    iterations, costs = 0, [fit.cost]
    while iterations < max_iterations:
        check_time()
        if is_late(deadline):
            status = "deadline"
            break
        try:
            enough = tolerance * fit.cost
            if is_smooth:
                enough = max(enough, LEAST_FALL_NATS * max(1.0, 2.0 * fit.cost / n_readings))
            move = _move(problem, x, fit, equations, damping, enough if is_smooth and accelerated else np.inf)
            if move.gain > LEAST_GAIN:
                ahead = normal_equations(problem, x + move.step, move.fit)
        except NUMERICAL_FAILURES:
            status = "numerical_failure"
            break
        if move.gain > LEAST_GAIN:
            fall = fit.cost - move.fit.cost
            x, fit, equations, iterations = x + move.step, move.fit, ahead, iterations + 1
            damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * min(move.gain, 1.0) - 1.0) ** 3), 2.0
            costs.append(fit.cost)
            if fall < enough:
                status = "converged"
                break
            pace = (costs[-1 - PACE_STEPS] - fit.cost) / PACE_STEPS if iterations >= PACE_STEPS else np.inf
            if fit.cost - problem.prior_cost(x) - LEEWAY * pace * (2 * max_iterations - iterations) > goal:
                status = "given_up"
                break
        elif 0.0 <= move.predicted <= enough:
            status = "converged"
            break
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > 1e12:
                status = "stalled"
                break
    return Optimum(x, fit, equations.hessian, status, iterations)


@dataclass(frozen=True)
class _Move:
    """A step, the model after it, the fall of the cost that a quadratic model foretells, and the true one over it."""

    step: FloatArray
    fit: Fit
    predicted: float
    gain: float


def _move(
    problem: Problem, x: FloatArray, fit: Fit, equations: NormalEquations, damping: float, enough: float
) -> _Move:
    """Return the damped step from a point, corrected for what it bends where that lowers the cost further.

    Steps that promise a fall of no more than ``enough`` are not corrected.
    """
    hessian, gradient = equations.hessian, equations.gradient
    bounds = problem.step_bounds(x, LARGEST_STEP)
    step = bounded_step(partial(_step, damping=damping), hessian, gradient, *bounds)
    predicted = -float(gradient @ step + 0.5 * step @ hessian @ step)

    def moved(by: FloatArray, near: Fit) -> _Move:
        there = problem.solve(x + by, near)
        gain = (fit.cost - there.cost) / max(abs(predicted), 1e-300) if np.isfinite(there.cost) else -1.0
        return _Move(by, there, predicted, gain)

    straight = moved(step, fit)
    is_straight = abs(straight.gain - 1.0) < STRAIGHT
    if is_straight or predicted <= enough or not (equations.slopes and np.isfinite(straight.fit.cost)):
        return straight
    correction = _step(hessian, equations.curvature(fit, straight.fit, step), damping)
    length = np.sqrt(np.diag(hessian))
    if not np.linalg.norm(length * correction) < MOST_BENT * np.linalg.norm(length * step):
        return straight
    bent = moved(np.clip(step + correction, *bounds), straight.fit)
    return bent if bent.gain > straight.gain else straight
