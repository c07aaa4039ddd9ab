"""The paper's regression of smoothed forces on temperature, every one an independent sample: eqs. 33-38."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.gp.basis import Basis
from twin_core.gp.polynomial import ForcePolynomial


def regress_pointwise(
    temperature_K: FloatArray,
    force_W: FloatArray,
    force_std_W: FloatArray,
    *,
    degree: int,
    boundary_K: FloatArray | None = None,
    vanishing: bool = False,
    prior_std_W: float = np.inf,
) -> ForcePolynomial:
    """Regress as the paper does: every smoothed force an independent sample with the average variance (eqs. 33-38).

    The mean of its weights is good, their covariance far too small, since neighbouring smoothed forces repeat each other;
    the average variance, added to every prediction, makes the band wide whatever the record. Use
    :func:`twin_core.latent_force.regression.learn_heat_flow` where the band matters.

    Parameters
    ----------
    temperature_K, force_W, force_std_W : (n_times,)
        Smoothed temperature of the node, force on it, and the force's standard deviation.
    degree
        Total degree.
    boundary_K : (n_times,), optional
    vanishing
        Powers of the difference to the boundary, without constant.
    prior_std_W
        Standard deviation of each weight a priori; infinite for least squares.

    Raises
    ------
    ModelError
        Nothing to fit, a number that is not finite, or a force without variance.
    """
    basis = Basis.over(degree, temperature_K, boundary_K, vanishing=vanishing)
    shapes = {np.shape(a) for a in (temperature_K, force_W, force_std_W)}
    if len(shapes) > 1:
        raise ModelError(f"temperature, force and its deviation must have one shape; they have {sorted(shapes)}")
    if not (np.isfinite(force_W).all() and np.isfinite(force_std_W).all() and np.min(force_std_W) >= 0.0):
        raise ModelError("the smoothed force must be finite and its standard deviation not negative")
    if not prior_std_W > 0.0:
        raise ModelError(f"prior_std_W must be positive, it is {prior_std_W}")
    terms = basis.terms(temperature_K, boundary_K)
    variance = float(np.mean(force_std_W**2))
    if not variance > 0:
        raise ModelError("the smoothed force has no variance; a regression needs one")
    precision = terms.T @ terms / variance + np.eye(terms.shape[1]) / prior_std_W**2
    cov = np.asarray(np.linalg.pinv(precision), dtype=np.float64)
    return ForcePolynomial(basis, cov @ (terms.T @ force_W) / variance, cov, float(np.sqrt(variance)))
