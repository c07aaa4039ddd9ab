"""A heat that repeats with temperature, as a Bayesian polynomial: centred, scaled, with a band that knows its range.

    q(T, T_b) = sum_j w_j x^a_j z^b_j,   x = (T - centre) / scale,   z likewise of the boundary temperature

Outside the visited range the mean stays what it is at the edge and the band takes in what the
polynomial itself would have said there: no silent extrapolation. Kouw et al. (CCTA 2024), eqs. 33-41.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial

from twin_core._typing import BoolArray, FloatArray, Json
from twin_core.errors import ModelError

SMALLEST_SCALE_K = 1e-3
"""Half-range below which a temperature counts as constant."""
HERMITE_POINTS = np.array([-np.sqrt(3.0), 0.0, np.sqrt(3.0)])
HERMITE_WEIGHTS = np.array([1.0, 4.0, 1.0]) / 6.0


@dataclass(frozen=True)
class Basis:
    """Powers of a scaled temperature (and of the scaled boundary temperature).

    Attributes
    ----------
    exponents : (n_terms, 2)
        Of x and z, by rising total degree.
    vanishing
        Whether x is (T - T_b) / scale and the constant is left out: no heat where there is no difference, as in
        convection, leaks and radiation. Otherwise x = (T - centre) / scale.
    centre_K, scale_K : (2,)
        Of x and z.
    low, high : (2,)
        Visited range of x and z.
    """

    exponents: tuple[tuple[int, int], ...]
    vanishing: bool
    centre_K: tuple[float, float]
    scale_K: tuple[float, float]
    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def over(
        cls, degree: int, temperature_K: FloatArray, boundary_K: FloatArray | None = None, *, vanishing: bool = False
    ) -> "Basis":
        """Return the basis of a total degree over visited temperatures; a constant boundary is no variable.

        Raises
        ------
        ModelError
            The degree is negative (vanishing: below one), temperatures are not finite, or the boundary is missing.
        """
        if degree < int(vanishing):
            raise ModelError(f"degree must be at least {int(vanishing)}, it is {degree}")
        if vanishing and boundary_K is None:
            raise ModelError("a vanishing basis needs the boundary temperature")
        b = np.zeros(1) if boundary_K is None else np.asarray(boundary_K, dtype=np.float64)
        t = np.asarray(temperature_K, dtype=np.float64) - (b if vanishing else 0.0)
        if t.size == 0 or not (np.isfinite(t).all() and np.isfinite(b).all()):
            raise ModelError("the polynomial needs finite temperatures")
        moving = boundary_K is not None and float(np.ptp(b)) > 2.0 * SMALLEST_SCALE_K
        centre, scale = (0.0, max(float(np.abs(t).max()), SMALLEST_SCALE_K)) if vanishing else _range(t)
        centre_b, scale_b = _range(b)
        exponents = [(k - j, j) for k in range(degree + 1) for j in range(k + 1 if moving else 1)]
        if vanishing:
            exponents = [(k, j) for k, j in exponents if k > 0]
        limits = [
            ((float(v.min()) - c) / s, (float(v.max()) - c) / s)
            for v, c, s in ((t, centre, scale), (b, centre_b, scale_b))
        ]
        (low, high), (low_b, high_b) = limits
        return cls(tuple(exponents), vanishing, (centre, centre_b), (scale, scale_b), (low, low_b), (high, high_b))

    @property
    def degree(self) -> int:
        """Highest total degree."""
        return max(a + b for a, b in self.exponents)

    def scaled(self, temperature_K: FloatArray, boundary_K: FloatArray | None = None) -> FloatArray:
        """Return x and z, (2, ...); without a boundary temperature its centre is taken."""
        t = np.asarray(temperature_K, dtype=np.float64)
        b = np.asarray(self.centre_K[1] if boundary_K is None else boundary_K, dtype=np.float64)
        t, b = np.broadcast_arrays(t, b)
        x = (t - (b if self.vanishing else self.centre_K[0])) / self.scale_K[0]
        return np.stack([x, (b - self.centre_K[1]) / self.scale_K[1]])

    def at_scaled(self, scaled: FloatArray) -> FloatArray:
        """Return the terms at scaled coordinates (2, ...), (..., n_terms)."""
        return np.stack([scaled[0] ** a * scaled[1] ** b for a, b in self.exponents], axis=-1)

    def terms(
        self, temperature_K: FloatArray, boundary_K: FloatArray | None = None, std_K: FloatArray | None = None
    ) -> FloatArray:
        """Return the terms, (..., n_terms); with ``std_K`` their mean over T ~ N(temperature_K, std_K²).

        The mean is by three-point Gauss-Hermite quadrature, exact to degree five: the smoothed temperature's own
        uncertainty takes part in the regression.
        """
        if std_K is None:
            return self.at_scaled(self.scaled(temperature_K, boundary_K))
        spread = [
            weight * self.at_scaled(self.scaled(temperature_K + point * std_K, boundary_K))
            for point, weight in zip(HERMITE_POINTS, HERMITE_WEIGHTS, strict=True)
        ]
        return np.sum(spread, axis=0)


@dataclass(frozen=True)
class Prediction:
    """Heat at given temperatures.

    Attributes
    ----------
    mean_W, std_W : (...)
        Mean and standard deviation of the heat itself (the misfit of the polynomial included).
    outside : (...)
        Whether the temperature lies outside the visited range: the mean is held, the band grown.
    """

    mean_W: FloatArray
    std_W: FloatArray
    outside: BoolArray


@dataclass(frozen=True)
class ForcePolynomial:
    """Posterior of a polynomial heat.

    Attributes
    ----------
    basis
        Terms and range.
    mean_W : (n_terms,)
    cov_W2 : (n_terms, n_terms)
        Of the weights.
    misfit_W
        Standard deviation of what is left of the heat beside the polynomial.
    log_evidence
        ln p(y | degree), the weights integrated out; comparable between degrees over the same data.
    """

    basis: Basis
    mean_W: FloatArray
    cov_W2: FloatArray
    misfit_W: float = 0.0
    log_evidence: float = float("nan")

    def predict(self, temperature_K: FloatArray, boundary_K: FloatArray | None = None) -> Prediction:
        """Predict the heat (eqs. 39-41), held at its edge value outside the visited range with a band that grows.

        Parameters
        ----------
        temperature_K : (...)
        boundary_K : (...), optional
            Needed where the basis has it.
        """
        raw = self.basis.scaled(temperature_K, boundary_K)
        low, high = (np.reshape(edge, (2, *(1,) * (raw.ndim - 1))) for edge in (self.basis.low, self.basis.high))
        held = np.clip(raw, low, high)
        outside = np.asarray((np.abs(raw - held) > 1e-9).any(axis=0))
        inner, outer = self.basis.at_scaled(held), self.basis.at_scaled(raw)
        mean = inner @ self.mean_W
        beyond = outer @ self.mean_W - mean
        variance = np.einsum("...i,ij,...j->...", outer, self.cov_W2, outer) + beyond**2 + self.misfit_W**2
        return Prediction(mean, np.sqrt(np.maximum(variance, 0.0)), outside)

    def effect_settings(self) -> tuple[Json, dict[str, float]]:
        """Return settings and values of the effect ``learned_heat_flow`` that is this polynomial's mean.

        Raises
        ------
        ModelError
            The polynomial depends on a boundary temperature.
        """
        if any(b for _, b in self.basis.exponents) or (self.basis.vanishing and self.basis.high[1] > self.basis.low[1]):
            raise ModelError("learned_heat_flow takes a polynomial of the node's own temperature")
        low, high = (self.basis.scale_K[0] * edge for edge in (self.basis.low[0], self.basis.high[0]))
        origin = self.basis.centre_K[1 if self.basis.vanishing else 0]
        centre, half = 0.5 * (low + high), max(0.5 * (high - low), SMALLEST_SCALE_K)
        weights = np.zeros(self.basis.degree + 1)
        for (power, _), weight in zip(self.basis.exponents, self.mean_W, strict=True):
            weights[power] = weight
        onto = Polynomial([centre / self.basis.scale_K[0], half / self.basis.scale_K[0]])
        moved = np.resize(Polynomial(weights)(onto).coef, weights.size)
        settings = {"degree": self.basis.degree, "centre_K": origin + centre, "scale_K": half, "reach": 1.0}
        return settings, {f"coefficients[{k}]": float(value) for k, value in enumerate(moved)}


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
        Nothing to fit, or a force without variance.
    """
    basis = Basis.over(degree, temperature_K, boundary_K, vanishing=vanishing)
    terms = basis.terms(temperature_K, boundary_K)
    variance = float(np.mean(force_std_W**2))
    if not variance > 0:
        raise ModelError("the smoothed force has no variance; a regression needs one")
    precision = terms.T @ terms / variance + np.eye(terms.shape[1]) / prior_std_W**2
    cov = np.asarray(np.linalg.pinv(precision), dtype=np.float64)
    return ForcePolynomial(basis, cov @ (terms.T @ force_W) / variance, cov, float(np.sqrt(variance)))


def _range(values: FloatArray) -> tuple[float, float]:
    low, high = float(np.min(values)), float(np.max(values))
    return 0.5 * (low + high), max(0.5 * (high - low), SMALLEST_SCALE_K)
