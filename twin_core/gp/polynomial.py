"""A heat that repeats with temperature, as a Bayesian polynomial: centred, scaled, with a band that knows its range.

    q(T, T_b) = sum_k c_k x^a_k z^b_k,   x = (T - centre) / scale,   z likewise of the boundary temperature

Outside the visited range the mean stays what it is at the edge and the band grows with every step away from it: no silent
extrapolation. Kouw et al. (CCTA 2024), eqs. 33-41.
"""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import BoolArray, FloatArray, Json
from twin_core.errors import ModelError
from twin_core.gp.basis import Basis


@dataclass(frozen=True)
class Prediction:
    """Heat at given temperatures.

    Attributes
    ----------
    mean_W, std_W : (...)
        Mean and standard deviation of the heat itself (the misfit of the polynomial included).
    outside : (...)
        Whether a temperature lies outside the visited range: the mean is held, the band grown.
    beyond_W : (...)
        The part of the standard deviation that the distance to the range adds; zero inside.
    """

    mean_W: FloatArray
    std_W: FloatArray
    outside: BoolArray
    beyond_W: FloatArray


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

    def heat_W(self, temperature_K: FloatArray, boundary_K: FloatArray | None = None) -> FloatArray:
        """Return the mean heat (eq. 41), held at its edge value outside the visited range, (...)."""
        return np.asarray(
            self.basis.at_scaled(self.basis.held(self.basis.scaled(temperature_K, boundary_K))) @ self.mean_W
        )

    def predict(self, temperature_K: FloatArray, boundary_K: FloatArray | None = None) -> Prediction:
        """Predict the heat (eqs. 39-41), held at its edge value outside the visited range with a band that grows.

        Parameters
        ----------
        temperature_K : (...)
        boundary_K : (...), optional
            Needed where the heat depends on it.

        Raises
        ------
        ModelError
            A temperature is not finite, or the boundary's is missing.
        """
        raw = self.basis.scaled(temperature_K, boundary_K)
        if not np.isfinite(raw).all():
            raise ModelError("the heat is asked for at a temperature that is not finite")
        held = self.basis.held(raw)
        away = np.abs(raw - held)
        outside = np.asarray((away > 1e-9).any(axis=0))
        terms = self.basis.at_scaled(held)
        beyond = np.zeros(outside.shape)
        beyond[outside] = self._growth(held[:, outside], away[:, outside])
        variance = np.einsum("...i,ij,...j->...", terms, self.cov_W2, terms) + self.misfit_W**2
        std = np.sqrt(np.maximum(variance, 0.0) + beyond**2)
        return Prediction(terms @ self.mean_W, std, outside, beyond)

    def _growth(self, held: FloatArray, away: FloatArray) -> FloatArray:
        """Return the deviation that distances ``away`` (2, n) from points of the range add, (n,).

        About the edge the polynomial is a sum of powers of the distance. Their magnitudes, one standard deviation
        included, add up to more than the polynomial can change, and never fall with distance whatever its degree. What
        no weight tells is taken to grow by the heat at the edge with every half-range of T, for T and T_b alike.
        """
        taylor = self.basis.taylor(held)
        mean = np.einsum("nkij,k->nij", taylor, self.mean_W)
        variance = np.einsum("nkij,kl,nlij->nij", taylor, self.cov_W2, taylor)
        size = np.abs(mean) + np.sqrt(np.maximum(variance, 0.0))
        size[:, 0, 0] = np.sqrt(mean[:, 0, 0] ** 2 + variance[:, 0, 0] + self.misfit_W**2)
        orders = np.arange(self.basis.degree + 1)
        powers = away[0][:, None, None] ** orders[:, None] * away[1][:, None, None] ** orders
        powers[:, 0, 0] = self.basis.scale_K @ away / self.basis.scale_K[0]
        return np.asarray((size * powers).sum(axis=(1, 2)))

    def effect_settings(self) -> tuple[Json, dict[str, float]]:
        """Return settings and values of the effect ``learned_heat_flow`` that is this polynomial.

        Its place is the node and, where ``basis.has_boundary``, the boundary.
        """
        basis = self.basis
        settings = {
            "degree": basis.degree,
            "vanishing": basis.vanishing,
            "low_K": basis.low_K,
            "high_K": basis.high_K,
            "misfit_W": self.misfit_W,
            "covariance_W2": tuple(self.cov_W2.ravel().tolist()),
        }
        return settings, {f"coefficients[{k}]": float(weight) for k, weight in enumerate(self.mean_W)}
