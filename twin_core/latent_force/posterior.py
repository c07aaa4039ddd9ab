"""The posterior density of hyperparameters under Gamma priors, with exact gradient and central-difference Hessian.

Kouw et al. (CCTA 2024), eqs. 30-31, in logarithms of the parameters.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.score import score
from twin_core.latent_force.model import ForceModel

DIFFERENCE = 1e-4
"""Step of ln(parameter) for the Hessian, the cube root of the gradient's rounding."""


@dataclass(frozen=True)
class GammaPrior:
    """Gamma distribution, density proportional to x^(shape - 1) exp(-rate x); ``rate`` in 1/unit."""

    shape: float
    rate: float

    def __post_init__(self) -> None:
        """Refuse what is not a distribution."""
        if not (0 < self.shape < np.inf and 0 < self.rate < np.inf):
            raise ModelError(f"Gamma prior: shape and rate must be positive, they are {self.shape} and {self.rate}")

    def log_density(self, x: FloatArray | float) -> FloatArray:
        """Return ln p(x)."""
        constant = self.shape * np.log(self.rate) - gammaln(self.shape)
        return np.asarray(constant + (self.shape - 1.0) * np.log(x) - self.rate * np.asarray(x))


class Posterior:
    """ln p(y | exp(point)) + ln prior density at exp(point), over logarithms of the parameters."""

    def __init__(self, model: ForceModel, observations: FloatArray, priors: Mapping[str, GammaPrior]) -> None:
        """Take a model, samples (n_times, n_sensors), and priors by parameter name; a name without prior is flat."""
        unknown = set(priors) - set(model.names)
        for name, prior in priors.items():
            if not isinstance(prior, GammaPrior):
                raise ModelError(f"prior for '{name}': must be a GammaPrior, it is {prior!r}")
        if unknown:
            raise ModelError(f"prior for '{sorted(unknown)[0]}': the parameters are {', '.join(model.names)}")
        self.model, self.observations = model, observations
        self.priors = [priors.get(name) for name in model.names]

    def has_prior(self, name: str) -> bool:
        """Return whether a parameter has a prior."""
        return self.priors[self.model.names.index(name)] is not None

    def value(self, point: FloatArray) -> float:
        """Return the log posterior density, -inf where the model has no likelihood."""
        with np.errstate(over="ignore"):
            values = np.exp(point)
        if not np.isfinite(values).all() or not (values > 0).all():
            return -np.inf
        filtered = kalman_filter(self.model.linear_model(values), self.observations, keep="likelihood")
        total = filtered.log_likelihood + self._prior(values)[0]
        return total if np.isfinite(total) else -np.inf

    def expand(self, point: FloatArray) -> tuple[float, float, FloatArray, FloatArray]:
        """Return log posterior, log-likelihood, gradient (n_free,) and positive curvature (n_free, n_free)."""
        values = np.exp(point)
        found = score(self.model.linear_model(values), self.model.slopes(values), self.observations)
        prior, gradient, curvature = self._prior(values)
        return (
            found.log_likelihood + prior,
            found.log_likelihood,
            found.gradient + gradient,
            found.information + np.diag(curvature),
        )

    def hessian(self, point: FloatArray) -> FloatArray:
        """Return the second derivatives in the logarithms, (n_free, n_free)."""
        rows = []
        for p in range(point.size):
            shift = DIFFERENCE * np.eye(point.size)[p]
            rows.append((self.expand(point + shift)[2] - self.expand(point - shift)[2]) / (2.0 * DIFFERENCE))
        matrix = np.array(rows).reshape(point.size, point.size)
        return 0.5 * (matrix + matrix.T)

    def prior_curvature(self, point: FloatArray) -> FloatArray:
        """Return minus the prior's second derivatives in the logarithms, (n_free,)."""
        return self._prior(np.exp(point))[2]

    def _prior(self, values: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return ln prior, its gradient and minus its curvature in the logarithms."""
        total, gradient, curvature = 0.0, np.zeros(values.size), np.zeros(values.size)
        for p, prior in enumerate(self.priors):
            if prior is not None:
                total += float(prior.log_density(values[p]))
                gradient[p] = prior.shape - 1.0 - prior.rate * values[p]
                curvature[p] = prior.rate * values[p]
        return total, gradient, curvature
