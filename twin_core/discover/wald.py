"""Wald test of effects: whether a record determines their size. Confounded ones fit well at many sizes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from twin_core._typing import FloatArray, IntArray
from twin_core.calibrate.containment import attempted
from twin_core.calibrate.covariance import trajectory_covariance
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.residual_noise import stacked_jacobian
from twin_core.discover.trial import Trial, extended, fitted_effects, shared_unknowns
from twin_core.effects.base import Effect

LESS = 0.1
"""Share of an effect that is taken away where its whole leaves another model: without the radiation that carries most of a
plate's heat, temperatures hang on a film that nothing tells beside it, and the radiation seems to have no size."""


def least_wald_score(simple: Trial, rich: Trial) -> float:
    """Return by how many of its standard deviations what an effect does to the readings differs from nothing: the least told.

    What it does is the difference of two open-loop trajectories, with it and without, all else alike; or with it and with less
    of it, whichever is told better: heat that adds up is told as well by both, one that other parameters hang on by a part of
    it, and a limit that is never reached with less of it by the whole. How certain that is follows from the covariance of all
    unknowns by the delta method; the misfit that wanders counts as noise (Huber 1967). Both are in units of each sensor's
    noise, rms over readings. Where the readings are likelier beside gradients within the nodes, what these explain does not
    count as noise, and a size that is told there is told. A load with the period of a declared input, say, may have any size if
    the capacity follows: its score is near one, however much likelier the readings are with it. That nobody knows how large all
    heat flows are together does not count: two trajectories tell the same then.

    Parameters
    ----------
    simple
        The trial without the effects.
    rich
        With them, each of which is asked.

    Returns
    -------
    float
        Zero where an effect does nothing, infinite where nothing but they holds the trajectories together.

    Raises
    ------
    ArithmeticError
        Where the covariance is not finite.
    """
    calibration, gradients = rich.calibration(), rich.beside_gradients()
    problem, optimum = calibration.problem, calibration.optimum
    fitted = [_Fitted(problem, optimum, trajectory_covariance(problem, optimum, calibration.whitener))]
    if gradients is not None and gradients.log_posterior > calibration.log_posterior:
        covariance = attempted(gradients.covariance, "the covariance beside gradients within nodes", [])
        fitted += [] if covariance is None else [_Fitted(gradients.problem, gradients.optimum, covariance)]
    new = [effect for effect in rich.effects if effect.place not in {known.place for known in simple.effects}]
    size = max(_least_score(simple, rich.effects, new, one) for one in fitted)
    # A law must hold where it is handed out, which is along plain trajectories.
    bounds = (score for effect in new for score in _scores_of_bounds(fitted[0], effect))
    return min([size, *bounds])


@dataclass(frozen=True)
class _Fitted:
    """A network with effects, fitted to trajectories, and the covariance of its unknowns, (n_unknowns, n_unknowns)."""

    problem: Problem
    optimum: Optimum
    covariance: FloatArray

    @property
    def values(self) -> dict[str, float]:
        """Full parameter name -> calibrated value."""
        return self.problem.network.parameters.at_free(self.optimum.unknowns[: self.problem.n_free]).as_dict()


def _least_score(simple: Trial, effects: Sequence[Effect], new: Sequence[Effect], fitted: _Fitted) -> float:
    """Return the least score of the new ones among the effects of a fitted network, which a simpler trial lacks."""
    if not np.isfinite(fitted.covariance).all():
        raise ArithmeticError("the covariance of the effects is not finite")
    blocks = fitted.problem.jacobian_blocks(fitted.optimum.unknowns, fitted.optimum.fit)
    slopes = stacked_jacobian(fitted.problem, blocks)
    scores = []
    for own in fitted_effects(new, fitted.values):
        rest = [e for e in effects if e.place != own.place]
        others = _without(fitted, simple.fit.problem, rest), _with_less(fitted, own)
        scores.append(max(_score(fitted, slopes, other) for other in others))
    return min(scores, default=np.inf)


def _scores_of_bounds(fitted: _Fitted, effect: Effect) -> list[float]:
    """Return how many standard deviations lie between each value of a law and the bounds at which it breaks down.

    Neither evidence nor score holds on a bound (Self and Liang 1987), and other parameters take such a law's place: a property
    that comes to nothing within what the record visits is none.
    """
    names, values = fitted.problem.network.parameters.free_names, fitted.values
    found = []
    for spec in effect.parameter_specs():
        name = f"{effect.label}.{spec.name}"
        if spec.breaks_down and name in names:
            at = names.index(name)
            value, std = values[name], float(np.sqrt(fitted.covariance[at, at]))
            edges = [edge for edge in (spec.lower, spec.upper) if edge is not None]
            found += [abs(value - edge) / std for edge in edges]
    return found


@dataclass(frozen=True)
class _Other:
    """A network without an effect, or with less of it.

    Attributes
    ----------
    problem, unknowns
        Its problem, of the same telemetry, and where it stands.
    own : (n_unknowns,)
        Which unknown of the fitted network each follows.
    slopes : (n_unknowns,)
        By how much.
    unsolved
        The score where its balance has no solution.
    """

    problem: Problem
    unknowns: FloatArray
    own: IntArray
    slopes: FloatArray
    unsolved: float


def _without(fitted: _Fitted, declared: Problem, rest: Sequence[Effect]) -> _Other:
    """Return a network without the effect that is not among the rest."""
    problem = extended(declared, rest) if rest else declared
    own = shared_unknowns(fitted.problem, problem)
    return _Other(problem, fitted.optimum.unknowns[own], own, np.ones(own.size), np.inf)


def _with_less(fitted: _Fitted, effect: Effect) -> _Other:
    """Return a network with less of an effect, which is at its calibrated values."""
    problem, unknowns = fitted.problem, fitted.optimum.unknowns.copy()
    parameters = problem.network.parameters.at_free(unknowns[: problem.n_free])
    less = parameters.updated({p.name: p.value for p in effect.shortened(1.0 - LESS).parameters()})
    amplitudes = {f"{effect.label}.{q.name}" for q in effect.parameter_specs() if q.null is not None}
    left = np.array([1.0 - LESS if name in amplitudes else 1.0 for name in parameters.free_names])
    slopes = np.ones(unknowns.size)
    slopes[: problem.n_free] = left * parameters.slopes(parameters.free) / less.slopes(less.free)
    unknowns[: problem.n_free] = less.free
    return _Other(problem, unknowns, np.arange(unknowns.size), slopes, 0.0)


def _score(fitted: _Fitted, slopes: FloatArray, other: _Other) -> float:
    """Return the score of what a fitted network has and another one lacks.

    Parameters
    ----------
    fitted
        The network.
    slopes : (n_samples, n_sensors, n_unknowns)
        Derivatives of its predicted readings, in K.
    other
        What lacks something.
    """
    optimum, noise_K = fitted.optimum, fitted.problem.noise_K
    fit = other.problem.solve(other.unknowns)
    if not np.isfinite(fit.cost):
        return other.unsolved
    done_K = np.concatenate(optimum.fit.predicted_K) - np.concatenate(fit.predicted_K)
    change = slopes.copy()
    jacobian = stacked_jacobian(other.problem, other.problem.jacobian_blocks(other.unknowns, fit))
    change[:, :, other.own] -= jacobian * other.slopes
    valid = np.isfinite(np.concatenate(fitted.problem.residuals(optimum.fit)))
    variance_K2 = np.einsum("tsi,tsi->ts", change @ fitted.covariance, change)
    squares, variances = (np.where(valid, a / noise_K**2, 0.0).sum() for a in (done_K**2, variance_K2))
    return float(np.sqrt(squares / variances)) if squares > 0.0 else 0.0


def score_needed(needed: float) -> float:
    """Return the score that an effect must reach: two-sided at odds of ``needed`` nats.

    Its evidence has paid for the candidates that were tried; here it is asked whether it has a size.
    """
    return float(-ndtri(0.5 * np.exp(-needed)))
