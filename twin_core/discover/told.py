"""Whether a record tells how much effects do: confounded ones fit well at many sizes, and predict well at none."""

import numpy as np
from scipy.stats import norm

from twin_core.calibrate.covariance import trajectory_covariance
from twin_core.calibrate.residual_noise import stacked_jacobian
from twin_core.discover.confirm import Trial, reduced, shared_unknowns


def standard_score(simple: Trial, rich: Trial) -> float:
    """Return by how many of its standard deviations what the new effects do to the readings differs from nothing.

    What they do is the difference of two open-loop trajectories, with them and without, all else alike. How certain that is
    follows from the covariance of all unknowns by the delta method; the misfit that wanders counts as noise (Huber 1967). Both
    are in units of each sensor's noise, rms over readings. A load with the period of a declared input, say, may have any size
    if the capacity follows: its score is near one, however much likelier the readings are with it. That nobody knows how large
    all heat flows are together does not count: two trajectories tell the same then.

    Parameters
    ----------
    simple
        The trial without the effects.
    rich
        With them.

    Returns
    -------
    float
        Zero where the effects do nothing, infinite where nothing but they holds the trajectories together.

    Raises
    ------
    ArithmeticError
        Where the covariance is not finite.
    """
    calibration, simpler = rich.calibration(), simple.fit.problem
    problem, optimum = calibration.problem, calibration.optimum
    unknowns = reduced(calibration, simpler)
    without = simpler.solve(unknowns)
    if not np.isfinite(without.cost):
        return np.inf
    done_K = np.concatenate(optimum.fit.predicted_K) - np.concatenate(without.predicted_K)
    slopes = stacked_jacobian(problem, problem.jacobian_blocks(optimum.unknowns, optimum.fit))
    slopes[:, :, shared_unknowns(calibration, simpler)] -= stacked_jacobian(
        simpler, simpler.jacobian_blocks(unknowns, without)
    )
    covariance = trajectory_covariance(problem, optimum, calibration.whitener)
    if not np.isfinite(covariance).all():
        raise ArithmeticError("the covariance of the effects is not finite")
    valid = np.isfinite(np.concatenate(calibration.residuals))
    variance_K2 = np.einsum("tsi,tsi->ts", slopes @ covariance, slopes)
    squares, variances = (np.where(valid, a / problem.noise_K**2, 0.0).sum() for a in (done_K**2, variance_K2))
    return float(np.sqrt(squares / variances)) if squares > 0.0 else 0.0


def score_needed(needed: float, n_tried: int) -> float:
    """Return the score that an effect must reach: two-sided at odds of ``needed`` nats for all that were tried (Bonferroni)."""
    return float(norm.isf(0.5 * np.exp(-needed) / max(n_tried, 1)))
