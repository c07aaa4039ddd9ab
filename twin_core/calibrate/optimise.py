"""Levenberg-Marquardt on the normal equations: a second-order solver whose outcome is a value, never silence."""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from twin_core._typing import FloatArray
from twin_core.calibrate.bounded import bounded_step
from twin_core.calibrate.containment import NO_DEADLINE, NUMERICAL_FAILURES, check_time, is_late
from twin_core.calibrate.problem import Fit, Problem

Status = Literal[
    "converged", "stalled", "iteration_limit", "early_stopping", "deadline", "numerical_failure", "no_solution"
]

ADVICE: dict[Status, str] = {
    "converged": "the cost no longer falls",
    "stalled": "no step lowers the cost any more: the data hardly tell some parameters apart",
    "iteration_limit": "stopped at the iteration limit while the cost still fell: start from better guesses",
    "early_stopping": "the error on the validation windows no longer falls",
    "deadline": "stopped at the deadline while the cost still fell: this is the best so far, give it more time",
    "numerical_failure": "a step could not be computed, the best before it is kept: check units and known values",
    "no_solution": "the heat balance has no solution there: check the order of magnitude of loads and radiators",
}

LARGEST_STEP = 2.0
"""Longest move of a logarithmic parameter in one iteration: a factor of e^2."""


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
        Stop when an accepted step lowers the cost by less than this share.
    deadline
        On the clock of ``time.monotonic``: no step is begun afterwards.

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
        hessian, gradient = _normal_equations(problem, x, fit)
    except NUMERICAL_FAILURES:
        return Optimum(x, fit, np.eye(x.size), "numerical_failure", 0)
    damping, growth = 1e-3, 2.0
    status: Status = "iteration_limit"
    iterations = 0
    while iterations < max_iterations:
        check_time()
        if is_late(deadline):
            status = "deadline"
            break
        try:
            step = bounded_step(
                partial(_step, damping=damping), hessian, gradient, *problem.step_bounds(x, LARGEST_STEP)
            )
            predicted = -(gradient @ step + 0.5 * step @ hessian @ step)
            trial = problem.solve(x + step, fit)
            fell = fit.cost - trial.cost
            gain = fell / max(abs(float(predicted)), 1e-300) if np.isfinite(trial.cost) else -1.0
            if gain > 1e-4:
                equations = _normal_equations(problem, x + step, trial)
        except NUMERICAL_FAILURES:
            status = "numerical_failure"
            break
        if gain > 1e-4:
            fall = fell / max(fit.cost, 1e-300)
            x, fit, iterations = x + step, trial, iterations + 1
            damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
            hessian, gradient = equations
            if fall < tolerance:
                status = "converged"
                break
        elif 0.0 <= predicted <= tolerance * fit.cost:
            status = "converged"
            break
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > 1e12:
                status = "stalled"
                break
    return Optimum(x, fit, hessian, status, iterations)


def _normal_equations(problem: Problem, unknowns: FloatArray, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Return Hessian and gradient; ArithmeticError where the sensitivities have overflowed."""
    hessian, gradient = problem.normal_equations(unknowns, fit)
    if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
        raise ArithmeticError("the sensitivities are not finite")
    return hessian, gradient
