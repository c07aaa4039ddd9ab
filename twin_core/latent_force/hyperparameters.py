"""Hyperparameters by maximum a posteriori under Gamma priors, and their Laplace covariance.

Kouw et al. (CCTA 2024), eqs. 30-32. The climb is Fisher scoring in logarithms of the parameters with exact gradients,
finished by Newton steps; the Hessian is the central difference of the exact gradient.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.gp.checked import numbers
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.posterior import GammaPrior, Posterior

LONGEST_STEP = 1.5
"""Largest change of ln(parameter) in one step of the climb."""
MAX_STEPS = 60
GAIN_LIMIT = 1e-9
"""The climb ends when a full step promises less than this many nats."""
MAX_NEWTON_STEPS = 5
NEWTON_LIMIT = 1e-6
"""A Newton step that promised less than this many nats ends at rest: what it leaves is of the order of its square."""
FLAT = 1e-2
"""A maximum whose curvature falls below this in any direction of ln(parameters), a factor of 20 000 either way, is none."""
BLIND_STD = 2.0
"""Standard deviation of ln(parameter) from the data alone above which a direction is called not identifiable."""


Outcome = Literal["maximum", "not at rest", "no maximum"]
ADVICE: dict[Outcome, str] = {
    "maximum": "None needed; heed the notices.",
    "not at rest": "Start from where it stopped, or give priors to the parameters that trade for each other.",
    "no maximum": "Give priors to the parameters that the notices name, or hold them: the data leave them open.",
}


@dataclass(frozen=True)
class MapFit:
    """Parameters at the maximum of the posterior.

    Attributes
    ----------
    names
        Of the parameters.
    values : (n_free,)
        At the maximum.
    covariance : (n_free, n_free)
        Laplace: inverse of the negative Hessian of ln p(y, values) in the values themselves (eq. 32); NaN without a
        maximum.
    log_covariance : (n_free, n_free)
        The same in their logarithms, better where a posterior is wide.
    log_likelihood, log_posterior
        ln p(y | values), and with the prior density (not normalised by the evidence).
    outcome
        How the climb ended; :attr:`advice` tells what to do about it.
    n_steps
        Steps of the climb.
    notices
        What the data cannot tell, in words.
    """

    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    log_covariance: FloatArray
    log_likelihood: float
    log_posterior: float
    outcome: Outcome
    n_steps: int
    notices: tuple[str, ...] = ()

    @property
    def converged(self) -> bool:
        """Whether the climb ended at a maximum."""
        return self.outcome == "maximum"

    @property
    def advice(self) -> str:
        """What to do about the outcome."""
        return ADVICE[self.outcome]

    @property
    def std(self) -> FloatArray:
        """Standard deviations, (n_free,)."""
        return np.sqrt(np.diag(self.covariance))

    def named(self) -> dict[str, float]:
        """Return name -> value."""
        return {name: float(value) for name, value in zip(self.names, self.values, strict=True)}


def fit_map(
    model: ForceModel,
    observations: FloatArray,
    priors: Mapping[str, GammaPrior],
    start: Mapping[str, float] | Mapping[str, tuple[float, ...]],
) -> MapFit:
    """Find the parameters' maximum a posteriori and its Laplace covariance.

    Parameters
    ----------
    model
        Network, forces, sensors.
    observations : (n_times, n_sensors)
        NaN where missing.
    priors
        Name -> prior; names left out are flat.
    start
        Name -> first value, or several to be tried in all combinations (the best one is climbed).

    Returns
    -------
    MapFit

    Raises
    ------
    ModelError
        A name is wrong or missing, or no starting point has a likelihood.
    """
    posterior = Posterior(model, observations, priors)
    if set(start) != set(model.names):
        raise ModelError(f"start must name the parameters {', '.join(model.names)}; it names {', '.join(start)}")
    if not model.names:
        raise ModelError("the model has no parameter to fit: give it a latent force, or names of parameters")
    tried = {name: np.atleast_1d(numbers(start[name], f"start of '{name}'")) for name in model.names}
    for name, values in tried.items():
        if not (values.size and (values > 0.0).all()):
            raise ModelError(f"start of '{name}': must be positive, it is {start[name]}")
    points = [np.log(p) for p in product(*tried.values())]
    ranked = [(posterior.value(p), k) for k, p in enumerate(points)] if len(points) > 1 else [(0.0, 0)]
    best, which = max(ranked)
    if not np.isfinite(best):
        raise ModelError("no starting point has a finite likelihood; check units and noise")
    point, n_steps, converged = _climb(posterior, np.asarray(points[which], dtype=np.float64))
    return _laplace(posterior, point, n_steps, converged)


def _climb(posterior: Posterior, point: FloatArray) -> tuple[FloatArray, int, bool]:
    """Climb by damped scoring steps; return the point, the steps taken and whether it is a maximum."""
    value, _, gradient, curvature = posterior.expand(point)
    damping = 1e-3
    for n_steps in range(1, MAX_STEPS + 1):
        scale = np.diag(np.maximum(np.diag(curvature), 1e-6))
        step = np.linalg.solve(curvature + damping * scale, gradient)
        if gradient @ step < GAIN_LIMIT:
            return point, n_steps, True
        step *= min(1.0, LONGEST_STEP / float(np.abs(step).max()))
        proposed = posterior.value(point + step)
        if proposed > value:
            point = point + step
            damping = max(0.2 * damping, 1e-8)
            value, _, gradient, curvature = posterior.expand(point)
        elif damping > 1e10:
            return point, n_steps, bool(gradient @ step < 1e-3)
        else:
            damping *= 10.0
    return point, MAX_STEPS, False


def _polish(posterior: Posterior, point: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """Climb on by Newton steps; return the point, the Hessian beside it and whether it is at rest."""
    for _ in range(MAX_NEWTON_STEPS):
        hessian, gradient = posterior.hessian(point), posterior.expand(point)[2]
        if np.linalg.eigvalsh(hessian).max() > -FLAT:
            break
        step = np.linalg.solve(-hessian, gradient)
        if np.abs(step).max() > 0.3 or posterior.value(point + step) < posterior.value(point):
            break
        point = point + step
        if gradient @ step < NEWTON_LIMIT:
            return point, hessian, True
    return point, hessian, False


def _laplace(posterior: Posterior, point: FloatArray, n_steps: int, converged: bool) -> MapFit:
    """Turn the curvature at the maximum into covariances."""
    point, hessian, polished = _polish(posterior, point)
    value, likelihood, gradient, _ = posterior.expand(point)
    values = np.exp(point)
    notices = _blind_directions(posterior, point, hessian)
    curvature = (hessian - np.diag(gradient)) / np.outer(values, values)
    names = posterior.model.names
    if np.linalg.eigvalsh(hessian).max() > -FLAT:
        blank = np.full(hessian.shape, np.nan)
        return MapFit(names, values, blank, blank, likelihood, value, "no maximum", n_steps, notices)
    covariance, log_covariance = (np.asarray(np.linalg.inv(-m), dtype=np.float64) for m in (curvature, hessian))
    outcome: Outcome = "maximum" if converged or polished else "not at rest"
    return MapFit(names, values, covariance, log_covariance, likelihood, value, outcome, n_steps, notices)


def _blind_directions(posterior: Posterior, point: FloatArray, hessian: FloatArray) -> tuple[str, ...]:
    """Name the parameters that the data alone, without priors, leave open."""
    alone = -hessian - np.diag(posterior.prior_curvature(point))
    strengths, directions = np.linalg.eigh(alone)
    notices = []
    for strength, direction in zip(strengths, directions.T, strict=True):
        if strength < BLIND_STD**-2:
            shares = np.abs(direction) / np.abs(direction).max()
            named = [name for name, share in zip(posterior.model.names, shares, strict=True) if share > 0.3]
            verb = "is" if len(named) == 1 else "together are"
            held = any(posterior.has_prior(name) for name in named)
            told = "the prior decides" if held else "there is no prior either"
            notices.append(f"{' and '.join(named)} {verb} not identifiable from these data: {told}")
    return tuple(notices)
