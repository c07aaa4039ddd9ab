"""The hierarchical model of a family, Gaussian in the solver's coordinate (ln for positive parameters).

Sibling i has parameters theta_i ~ N(mu, diag(tau^2)), and its own telemetry says l_i with information L_i (the inverse of its
covariance once the prior of its calibration is taken off). Population and siblings are estimated together by expectation
maximisation; a parameter that a sibling's telemetry does not determine comes from the others. Gelman et al., *Bayesian Data
Analysis* (3rd ed.), chapters 5 and 13. The likelihood of the spread is restricted and weighted with the spread itself: without
that, few siblings seem to be alike, and their intervals are too short (Chung et al. 2013, doi:10.1007/s11336-013-9328-2).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from twin_core._typing import BoolArray, FloatArray
from twin_core.calibrate.result import CalibratedModel
from twin_core.errors import ModelError

LEAST_SPREAD = 2e-3
"""Standard deviation in ln, 0.2 %: less than what parts are made to. It keeps the population's precision finite."""
ITERATIONS, TOLERANCE = 1000, 1e-6
"""Of expectation maximisation, which stops where mean and spread move by less, in ln: far below the least spread."""
PASSES = 4
"""So often at most the population is learned anew without those that differ from it; it ends where the same ones differ again."""
OUTLYING = 4.0
"""In robust standard deviations: who lies further away has no say in the first of these passes. Of fifty healthy siblings with
five parameters one is left out in two families of a hundred (6e-5 two-sided, Gaussian), and comes back in the second pass."""
WIDE = 1e6
"""Prior standard deviation that stands for none, in ln: its information, 1e-12, is below the 1e-9 that any record keeps."""
RATE = 0.01
"""False discovery rate at which a sibling differs from its family: of a hundred named, one is wrong on average."""
Z = 1.959963984540054
"""97.5 % quantile of the normal distribution: intervals are of 95 %."""


@dataclass(frozen=True)
class Member:
    """One sibling.

    Attributes
    ----------
    values
        Parameter name -> physical value, from its own telemetry and its family.
    low, high
        Ends of the 95 % interval.
    differs
        Parameter name -> two-sided p-value that it belongs to the family of the others, where the false discovery rate over
        all siblings and parameters calls it different.
    """

    values: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    differs: dict[str, float]


@dataclass(frozen=True)
class Family:
    """A population of spacecraft of one design.

    Attributes
    ----------
    names
        Of the free parameters, (n,).
    mean, mean_std, spread : (n,)
        Population mean, its standard error, and standard deviation from sibling to sibling, in the solver's coordinate.
    members
        Sibling -> what is known of it.
    """

    names: tuple[str, ...]
    mean: FloatArray
    mean_std: FloatArray
    spread: FloatArray
    members: dict[str, Member]


def pool(models: Mapping[str, CalibratedModel], rate: float = RATE) -> Family:
    """Return the family of models that were calibrated each on its own telemetry.

    Parameters
    ----------
    models
        Sibling -> model; all of one design: the same free parameters.
    rate
        False discovery rate of differences from the family.

    Raises
    ------
    ModelError
        If there are fewer than three siblings, or their free parameters are not the same.
    """
    if len(models) < 3:
        raise ModelError(f"a family needs three siblings at least (got {len(models)})")
    first = next(iter(models.values()))
    for name, model in models.items():
        if model.free_names != first.free_names or not model.free_names:
            raise ModelError(f"{name}: its free parameters are not those of its family")
    evidence = [_own(model) for model in models.values()]
    information, vector = np.stack([e[0] for e in evidence]), np.stack([e[1] for e in evidence])
    kept = ~_outlying(information, vector)
    for _ in range(PASSES):
        mean, spread = _population(information[kept], vector[kept])
        differs = _differences(information, vector, kept, (mean, spread), rate)
        before = kept
        kept = np.asarray(~np.isfinite(differs).any(axis=1), dtype=np.bool_)
        if (kept == before).all() or kept.sum() < 3:
            break
    mean_cov = _mean(information[before], vector[before], spread)[1]
    where, covariance = _posterior(information, vector, mean, spread, mean_cov, np.isfinite(differs))
    parameters = first.network().parameters
    transforms = [parameters.parameters[parameters.index[name]].transform for name in first.free_names]
    members = {}
    for i, name in enumerate(models):
        std = np.sqrt(np.diag(covariance[i]))
        values, low, high = (
            {p: float(t.to_value(x)) for p, t, x in zip(first.free_names, transforms, where[i] + z * std, strict=True)}
            for z in (0.0, -Z, Z)
        )
        found = {p: float(differs[i, k]) for k, p in enumerate(first.free_names) if np.isfinite(differs[i, k])}
        members[name] = Member(values, low, high, found)
    return Family(first.free_names, mean, np.sqrt(np.diag(mean_cov)), spread, members)


def _own(model: CalibratedModel) -> tuple[FloatArray, FloatArray]:
    """Return the information of a model's own telemetry, (n, n), and information times estimate, (n,), without its prior."""
    network = model.network()
    index = network.parameters.index
    chosen = [network.parameters.parameters[index[name]] for name in model.free_names]
    declared = _guesses(model)
    prior_std = np.array([WIDE if p.prior_std is None else p.prior_std for p in chosen])
    estimate = np.array([p.free for p in chosen])
    precision = np.linalg.inv(model.covariance)
    weight = np.diag(1.0 / prior_std**2)
    information = precision - weight
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    kept = np.maximum(values, 1e-9)
    information = (vectors * kept) @ vectors.T
    return information, precision @ estimate - weight @ declared


def _guesses(model: CalibratedModel) -> FloatArray:
    """Return where the prior of each free parameter of a model lies, (n,)."""
    from twin_core.network.model import build_network

    parameters = build_network(model.spec, model.effects, table_knots=model.table_knots).parameters
    return np.array([parameters.parameters[parameters.index[name]].free for name in model.free_names])


def _population(
    information: FloatArray, vector: FloatArray, start: tuple[FloatArray, FloatArray] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return population mean and spread, (n,) each, by expectation maximisation."""
    n_siblings, n = vector.shape
    if start is None:
        alone = np.linalg.solve(information + 1e-6 * np.eye(n), vector[..., None])[..., 0]
        mean = np.median(alone, axis=0)
        spread = np.clip(1.4826 * np.median(np.abs(alone - mean), axis=0), 0.01, 3.0)
    else:
        mean, spread = start
    for _ in range(ITERATIONS):
        new_mean, mean_cov = _mean(information, vector, spread)
        prior = np.diag(spread**-2.0)
        own = np.linalg.inv(information + prior)
        apart = own @ (vector + prior @ new_mean)[..., None] - new_mean[:, None]
        lever = own @ prior - np.eye(n)  # how far a sibling from its family moves with what is not known of the mean
        variance = np.diagonal(own + lever @ mean_cov @ np.swapaxes(lever, 1, 2), axis1=1, axis2=2)
        square = (apart[..., 0] ** 2 + variance).sum(axis=0)
        new_spread = np.maximum(np.sqrt(square / (n_siblings - 1)), LEAST_SPREAD)
        change = max(np.abs(new_mean - mean).max(), np.abs(new_spread - spread).max())
        mean, spread = new_mean, new_spread
        if change < TOLERANCE:
            break
    return mean, spread


def _mean(information: FloatArray, vector: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the generalised least squares estimate of the population mean and its covariance, given the spread."""
    between = np.diag(spread**2)
    factor = np.eye(spread.size) + information @ between
    weight = np.linalg.solve(factor, information)  # (L^-1 + T)^-1, also where L is singular
    told = np.linalg.solve(factor, vector[..., None])[..., 0]
    covariance = np.linalg.inv(weight.sum(axis=0) + 1e-9 * np.eye(spread.size))
    return covariance @ told.sum(axis=0), covariance


def _posterior(
    information: FloatArray,
    vector: FloatArray,
    mean: FloatArray,
    spread: FloatArray,
    mean_cov: FloatArray,
    strange: BoolArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the estimates of all siblings, (n_siblings, n), and their covariances, (n_siblings, n, n).

    Where a sibling is a stranger to its family in some parameter, its own telemetry alone tells that one.
    """
    weight = np.tile(spread**-2.0, (vector.shape[0], 1))
    if strange is not None:
        weight[strange] = WIDE**-2.0
    prior = weight[:, :, None] * np.eye(spread.size)
    own = np.linalg.inv(information + prior)
    where = np.einsum("ijk,ik->ij", own, vector + weight * mean)
    lever = own @ prior
    return where, own + lever @ mean_cov @ np.swapaxes(lever, 1, 2)


def _outlying(information: FloatArray, vector: FloatArray) -> BoolArray:
    """Return which siblings lie far from the median of all, each in its own uncertainty, (n_siblings,)."""
    own_cov = np.linalg.inv(information)
    estimate = np.einsum("ijk,ik->ij", own_cov, vector)
    own = np.diagonal(own_cov, axis1=1, axis2=2)
    apart = estimate - np.median(estimate, axis=0)
    beyond = np.maximum((1.4826 * np.median(np.abs(apart), axis=0)) ** 2 - np.median(own, axis=0), LEAST_SPREAD**2)
    far: BoolArray = (np.abs(apart) > OUTLYING * np.sqrt(own + beyond)).any(axis=1)
    return far if (~far).sum() >= 3 else np.zeros_like(far)


def _differences(
    information: FloatArray, vector: FloatArray, kept: BoolArray, start: tuple[FloatArray, FloatArray], rate: float
) -> FloatArray:
    """Return p-values of what does not belong to the family of the others, (n_siblings, n); NaN for all else."""
    n_siblings, n = vector.shape
    p = np.ones((n_siblings, n))
    for i in range(n_siblings):
        others = kept & (np.arange(n_siblings) != i)
        about, apart = _population(information[others], vector[others], start) if kept[i] else start
        mean_cov = _mean(information[others], vector[others], apart)[1]
        own_cov = np.linalg.inv(information[i])
        std = np.sqrt(np.diag(own_cov) + apart**2 + np.diag(mean_cov))
        p[i] = 2.0 * ndtr(-np.abs(own_cov @ vector[i] - about) / std)
    order = np.sort(p, axis=None)
    passing = np.flatnonzero(order <= rate * np.arange(1, order.size + 1) / order.size)  # Benjamini and Hochberg 1995
    threshold = order[passing[-1]] if passing.size else -1.0
    return np.where(p <= threshold, p, np.nan)
