"""How large the undeclared heat is: its size on each node and its correlation length, by maximum likelihood."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import BFGS

from twin_core._typing import FloatArray
from twin_core.calibrate.containment import check_time
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.undeclared.model import Nominal, UndeclaredHeat, log_likelihood, log_likelihood_and_slope

LENGTH_SHARES = (0.004, 0.02, 0.08)
"""Correlation lengths that are compared at first, as shares of the longest segment."""

LONGEST_SHARE = 0.1
"""The correlation length is at most this share of the record, so that lasting heat stays improbable."""

SMALLEST_LOG_STEP, LARGEST_LOG_STEP = 0.1, 2.5
"""Of the correlation length, and of any size, from pass to pass, in ln."""

SETTLED_NATS, SETTLED_LOG_STEP = 0.2, 0.3
"""A pass that adds less than this to the log-likelihood, with steps of the correlation length this small, is the last."""

N_ITERATIONS = 8
"""Of one pass: parameters move in between, so that no size need be final."""

STEP_SHARES = (1.0, 0.3, 0.1, 0.03)
"""Shares of a step that are tried in turn."""

LEAST_SLOPE_NATS, LEAST_GAIN_NATS = 0.03, 0.01
"""Per ln of a size, and per iteration: less is not followed. A size that no longer matters stays where it would matter again."""


@dataclass
class SizeSearch:
    """A search of the undeclared heat's size: along the slope on every node, and in steps of the length that shrink.

    Attributes
    ----------
    log_step
        Next change of the correlation length to be tried, in ln.
    curvature : (n_nodes, n_nodes)
        Of the log-likelihood in ln of the sizes, negated: what the passes so far have told of it.
    """

    log_step: float
    curvature: FloatArray | None = None

    def improve(
        self, problem: Problem, undeclared: UndeclaredHeat, nominals: Sequence[Nominal]
    ) -> tuple[UndeclaredHeat, float]:
        """Return a more likely size of the undeclared heat, and its log-likelihood."""
        best, value = self._along_the_slope(problem, undeclared, nominals)
        return self._with_a_likelier_length(problem, best, nominals, value)

    def settle_length(
        self, problem: Problem, undeclared: UndeclaredHeat, nominals: Sequence[Nominal], value: float
    ) -> tuple[UndeclaredHeat, float]:
        """Return undeclared heat of a likelier correlation length, and its log-likelihood, from that of the given one.

        Where nothing else moves any more steps of the length alone are tried, at a small part of the work of a pass, until they
        are short or add something.
        """
        best, found = undeclared, value
        while self.log_step >= SETTLED_LOG_STEP and found - value < SETTLED_NATS:
            best, found = self._with_a_likelier_length(problem, best, nominals, found)
        return best, found

    def _with_a_likelier_length(
        self, problem: Problem, best: UndeclaredHeat, nominals: Sequence[Nominal], value: float
    ) -> tuple[UndeclaredHeat, float]:
        """Return what is likelier a step of the length away, if anything is, and go on with a longer or shorter step."""
        moved = False
        for sign in (-1.0, 1.0):
            check_time()
            trial = _with_length(best, sign * self.log_step, nominals)
            found = log_likelihood(problem, trial, nominals)
            if found > value:
                best, value, moved = trial, found, True
                break
        self.log_step = float(np.clip(self.log_step * (1.4 if moved else 0.5), SMALLEST_LOG_STEP, LARGEST_LOG_STEP))
        return best, value

    def _along_the_slope(
        self, problem: Problem, undeclared: UndeclaredHeat, nominals: Sequence[Nominal]
    ) -> tuple[UndeclaredHeat, float]:
        """Return more likely sizes, and their log-likelihood.

        Sizes follow by a quasi-Newton method (BFGS; Nocedal and Wright 2006, section 6.1) on the exact slope of the likelihood.
        It remembers from pass to pass how the slope changes, so that most take a step or none.
        """
        value, slope = log_likelihood_and_slope(problem, undeclared, nominals)
        moved = np.zeros(slope.size)
        for iteration in range(N_ITERATIONS):
            step, self.curvature = self._newton_step(slope)
            step = np.clip(moved + step, -LARGEST_LOG_STEP, LARGEST_LOG_STEP) - moved
            promised = 0.5 * float(slope @ step)  # believed of a curvature that this pass has seen
            if np.abs(slope).max() < LEAST_SLOPE_NATS or (iteration > 0 and promised < LEAST_GAIN_NATS):
                break
            before = value
            for share in STEP_SHARES:
                check_time()
                trial = replace(undeclared, std_W=undeclared.std_W * np.exp(share * step))
                found, slope_there = log_likelihood_and_slope(problem, trial, nominals)
                if np.isfinite(found):
                    self.curvature = _updated(self.curvature, np.asarray(share * step), slope - slope_there)
                if found > value:
                    undeclared, value, slope, moved = trial, found, slope_there, moved + share * step
                    break
            if not value - before > LEAST_GAIN_NATS:
                break
        return undeclared, value

    def _newton_step(self, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the step that the slope asks for, and the curvature that it follows.

        A curvature that is none is forgotten: a start was beyond all likelihood.
        """
        if self.curvature is not None:
            with suppress(LinAlgError):
                factor = cho_factor(self.curvature, check_finite=False)
                return np.asarray(cho_solve(factor, slope, check_finite=False)), self.curvature
        scale = np.maximum(np.abs(slope), 1.0)
        return slope / scale, np.diag(scale)


def _updated(curvature: FloatArray, step: FloatArray, change: FloatArray) -> FloatArray:
    """Return a positive curvature that tells how the slope changed along a step, as far as it may (Powell's damping)."""
    if not change.any():
        return curvature
    known = BFGS(exception_strategy="damp_update", init_scale=curvature if step.size > 1 else curvature.item())
    known.initialize(step.size, "hess")
    known.update(step, change)
    return np.asarray(known.get_matrix())


def _with_length(undeclared: UndeclaredHeat, log_step: float, nominals: Sequence[Nominal]) -> UndeclaredHeat:
    """Return undeclared heat of another correlation length, within what the record can tell."""
    shortest = float(np.median(nominals[0].segment.forcing.step_s))
    longest = LONGEST_SHARE * span_s(nominals)
    return replace(undeclared, length_s=float(np.clip(undeclared.length_s * np.exp(log_step), shortest, longest)))


def span_s(nominals: Sequence[Nominal]) -> float:
    """Return the length of the longest segment."""
    return max(float(n.segment.record.time_s[-1] - n.segment.record.time_s[0]) for n in nominals)


def first_size(problem: Problem, values: FloatArray, nominals: Sequence[Nominal]) -> UndeclaredHeat:
    """Return a starting size: the heat that the linearised model lacks from sample to sample, and the best length.

    Parameters
    ----------
    problem
        Network and telemetry.
    values : (n_parameters,)
        Those about which the model was linearised: how much heat moves a node is up to its capacity there.
    nominals
        The linearised segments.
    """
    span = span_s(nominals)
    capacity = values[problem.network.capacity_index]
    swing = np.array([np.nanstd(n.starts_K, axis=0) for n in nominals]).max(axis=0)
    typical = 0.3 * capacity * np.maximum(swing, 0.1) / (0.02 * span)
    options = [UndeclaredHeat(typical, share * span) for share in LENGTH_SHARES]
    scored = [(fit_common(problem, option, nominals)) for option in options]
    return max(scored, key=lambda item: item[1])[0]


def fit_common(
    problem: Problem, undeclared: UndeclaredHeat, nominals: Sequence[Nominal]
) -> tuple[UndeclaredHeat, float]:
    """Return the best common factor of the undeclared heat, and its likelihood."""
    check_time()
    trials = [replace(undeclared, std_W=undeclared.std_W * f) for f in (10.0, 2.0, 0.4, 0.08, 0.016)]
    return max(((t, log_likelihood(problem, t, nominals)) for t in trials), key=lambda item: item[1])
