"""Wald test of effects: whether a record determines their size. Confounded ones fit well at many sizes."""

import numpy as np
from scipy.special import ndtri

from twin_core._typing import FloatArray
from twin_core.calibrate.covariance import trajectory_covariance
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.residual_noise import stacked_jacobian
from twin_core.calibrate.second_order import Calibration
from twin_core.discover.confirm import Trial, extended, reduced, shared_unknowns


def least_wald_score(simple: Trial, rich: Trial) -> float:
    """Return by how many of its standard deviations what an effect does to the readings differs from nothing: the least told.

    What it does is the difference of two open-loop trajectories, with it and without, all else alike. How certain that is
    follows from the covariance of all unknowns by the delta method; the misfit that wanders counts as noise (Huber 1967). Both
    are in units of each sensor's noise, rms over readings. A load with the period of a declared input, say, may have any size
    if the capacity follows: its score is near one, however much likelier the readings are with it. That nobody knows how large
    all heat flows are together does not count: two trajectories tell the same then.

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
    calibration = rich.calibration()
    covariance = trajectory_covariance(calibration.problem, calibration.optimum, calibration.whitener)
    if not np.isfinite(covariance).all():
        raise ArithmeticError("the covariance of the effects is not finite")
    known = {effect.place for effect in simple.effects}
    others = [[e for e in rich.effects if e is not own] for own in rich.effects if own.place not in known]
    problems = [extended(simple.fit.problem, rest) if rest else simple.fit.problem for rest in others]
    slopes = stacked_jacobian(
        calibration.problem,
        calibration.problem.jacobian_blocks(calibration.optimum.unknowns, calibration.optimum.fit),
    )
    return min((_score(calibration, slopes, covariance, problem) for problem in problems), default=np.inf)


def _score(rich: Calibration, slopes: FloatArray, covariance: FloatArray, without: Problem) -> float:
    """Return the score of what a problem lacks of a calibration.

    Parameters
    ----------
    rich
        The calibration.
    slopes : (n_samples, n_sensors, n_unknowns)
        Derivatives of its predicted readings, in K.
    covariance : (n_unknowns, n_unknowns)
        Of its unknowns.
    without
        The problem that lacks something, of the same telemetry.
    """
    problem, optimum = rich.problem, rich.optimum
    unknowns = reduced(rich, without)
    fit = without.solve(unknowns)
    if not np.isfinite(fit.cost):
        return np.inf
    done_K = np.concatenate(optimum.fit.predicted_K) - np.concatenate(fit.predicted_K)
    change = slopes.copy()
    change[:, :, shared_unknowns(rich, without)] -= stacked_jacobian(without, without.jacobian_blocks(unknowns, fit))
    valid = np.isfinite(np.concatenate(rich.residuals))
    variance_K2 = np.einsum("tsi,tsi->ts", change @ covariance, change)
    squares, variances = (np.where(valid, a / problem.noise_K**2, 0.0).sum() for a in (done_K**2, variance_K2))
    return float(np.sqrt(squares / variances)) if squares > 0.0 else 0.0


def score_needed(needed: float) -> float:
    """Return the score that an effect must reach: two-sided at odds of ``needed`` nats.

    Its evidence has paid for the candidates that were tried; here it is asked whether it has a size.
    """
    return float(-ndtri(0.5 * np.exp(-needed)))
