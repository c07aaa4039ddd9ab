"""The noise that a fit was made from, by restricted likelihood: what the parameters have absorbed of it is not forgotten.

A lumped network is never quite the truth, and its parameters bend until they follow as much of a slow misfit as they can.
What is left then looks whiter and smaller than what bent them. The restricted likelihood (Patterson and Thompson 1971) is
that of the part of the readings which no choice of parameters can follow, so that it counts the freedom that is spent.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from twin_core._typing import FloatArray
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.residual_noise import Whitener, sensor_jacobians
from twin_core.gp.noise_model import ResidualNoise

MOST_ROWS = 2000
"""Longer records are averaged over neighbouring readings: a slow misfit is seen as well, in less time."""

SHARES = (0.05, 0.15, 0.5, 1.5)
SPANS = (0.03, 0.17, 1.0)
"""Misfits that are weighed: their size in units of what is left, their length in those of the record. What lasts longer
than the record looks as if it lasted as long."""

SWEEPS = 3
"""Times that each sensor's misfit is weighed beside the likeliest of the others."""

UNTOLD = 1e-10
"""Combinations of unknowns that readings and priors tell less than this share of the best have no say."""

ROUNDING = 1e-9
"""Share of itself by which what each unknown is told may be wrong: it keeps a matrix of full rank one that is seen to be."""

LEAST_LIKELY = 1e-3
"""Misfits of less than this probability are left out of the average."""


@dataclass(frozen=True)
class Leftover:
    """What a fit leaves at one sensor, linearised.

    Attributes
    ----------
    time_s : (n_rows,)
        Times of the readings, or of the averages over ``together`` of them.
    columns : (n_rows, n_unknowns + 1)
        d predicted / d unknowns, and measured minus predicted, in K.
    together
        How many readings each row stands for.
    """

    time_s: FloatArray
    columns: FloatArray
    together: int = 1

    def weigh(self, model: ResidualNoise) -> tuple[float, FloatArray]:
        """Return ln det of the noise and the columns' products in its metric, (n_unknowns + 1, n_unknowns + 1)."""
        width_s = float(np.median(np.diff(self.time_s))) if self.together > 1 else 0.0
        averaged = replace(
            model,
            sigma_ou=model.sigma_ou * np.sqrt(_kept(width_s / model.length_s)),
            sigma_white=model.sigma_white / np.sqrt(self.together),
        )
        whitened, log_det = averaged.whiten(self.time_s, self.columns, np.ones(self.time_s.size, dtype=np.bool_))
        return log_det, whitened.T @ whitened


@dataclass(frozen=True)
class ExpectedNoise:
    """The covariance of one sensor's noise, averaged over what it may be.

    Attributes
    ----------
    white_K2
        Variance of the white part.
    coloured
        Variance in K² and correlation length in s of each Ornstein-Uhlenbeck part.
    """

    white_K2: float
    coloured: tuple[tuple[float, float], ...]


def _kept(width: float) -> float:
    """Return the share of an Ornstein-Uhlenbeck variance that an average over ``width`` lengths keeps."""
    return float(2.0 * (width - 1.0 + np.exp(-width)) / width**2) if width > 1e-4 else 1.0


def restricted_noise(
    problem: Problem, optimum: Optimum, whitener: Whitener, residuals: Sequence[FloatArray]
) -> list[ExpectedNoise]:
    """Return the noise of each sensor that a fit was made from.

    Parameters
    ----------
    problem, optimum
        The fit.
    whitener
        The noise of what it left.
    residuals : (n_samples, n_sensors) each
        What it left, per segment.
    """
    mean, std = problem.prior()
    rows = np.column_stack([np.diag(1.0 / std), (mean - optimum.unknowns) / std])
    span_s = max(float(np.ptp(segment.record.time_s)) for segment in problem.segments)
    return expected_noise(_leftovers(problem, optimum, whitener, residuals), rows.T @ rows, whitener.models, span_s)


def _leftovers(
    problem: Problem, optimum: Optimum, whitener: Whitener, residuals: Sequence[FloatArray]
) -> list[Leftover]:
    """Return what a fit leaves, sensor by sensor, with neighbouring readings of long records averaged."""
    residual = np.concatenate(list(residuals))
    segment = np.repeat(np.arange(len(problem.segments)), [s.record.time_s.size for s in problem.segments])
    found = []
    for sensor, jacobian in sensor_jacobians(problem, optimum):
        valid = whitener.valid[:, sensor]
        together = int(np.ceil(valid.sum() / MOST_ROWS))
        seen = [np.flatnonzero((segment == s) & valid) for s in range(len(problem.segments))]
        rows = np.concatenate([own[: own.size // together * together] for own in seen]).reshape(-1, together)
        columns = np.column_stack([jacobian, residual[:, sensor]])[rows].mean(axis=1)
        found.append(Leftover(whitener.time_s[rows].mean(axis=1), columns, together))
    return found


def restricted_log_likelihood(log_det: float, products: FloatArray) -> float:
    """Return the restricted log-likelihood, up to a constant.

    Parameters
    ----------
    log_det
        ln det Σ of the noise.
    products : (n_unknowns + 1, n_unknowns + 1)
        [J, r]ᵀ Σ⁻¹ [J, r] with those of the priors; J must be of full rank.
    """
    hessian = products[:-1, :-1]
    factor = np.linalg.cholesky(hessian + ROUNDING * np.diag(np.diag(hessian)))
    followed = solve_triangular(factor, products[:-1, -1], lower=True)
    left = max(float(products[-1, -1] - followed @ followed), 0.0)
    return float(-0.5 * (log_det + left) - np.log(np.diag(factor)).sum())


def expected_noise(
    left: Sequence[Leftover], prior: FloatArray, models: Sequence[ResidualNoise], span_s: float
) -> list[ExpectedNoise]:
    """Return the noise of each sensor, averaged over misfits by their restricted likelihood.

    How likely a misfit is before a sensor has spoken is learned from all of them (empirical Bayes): one sensor alone
    hardly shows what its parameters have followed, and the sensors of one network are wrong in similar ways.

    Parameters
    ----------
    left
        One per sensor.
    prior : (n_unknowns + 1, n_unknowns + 1)
        Priors of the unknowns, as products of columns like those of ``left``.
    models
        Noise of what was left, one per sensor.
    span_s
        Length of the longest segment.
    """
    turned = _told(left, prior, models)
    told = [replace(part, columns=part.columns @ turned) for part in left]
    options = [[model, *_misfits(model, span_s)] for model in models]
    weighed = [[part.weigh(m) for m in own] for part, own in zip(told, options, strict=True)]
    everywhere = [_sum([own[k] for own in weighed], turned.T @ prior @ turned) for k in range(len(options[0]))]
    best = int(np.argmax([restricted_log_likelihood(*total) for total in everywhere]))
    log_det, products = everywhere[best]
    chosen = [best] * len(left)
    common = first = np.full(len(options[0]), 1.0 / len(options[0]))
    shares = np.zeros((len(left), first.size))
    for _ in range(SWEEPS):
        for sensor, own in enumerate(weighed):
            log_det, products = log_det - own[chosen[sensor]][0], products - own[chosen[sensor]][1]
            told_by = np.array([restricted_log_likelihood(log_det + d, products + p) for d, p in own])
            shares[sensor] = common * np.exp(told_by - told_by.max())
            shares[sensor] /= shares[sensor].sum()
            chosen[sensor] = int(np.argmax(shares[sensor]))
            log_det, products = log_det + own[chosen[sensor]][0], products + own[chosen[sensor]][1]
        common = (first + shares.sum(axis=0)) / (1.0 + len(left))
    return [_average(own, share) for own, share in zip(options, shares, strict=True)]


def _misfits(model: ResidualNoise, span_s: float) -> list[ResidualNoise]:
    """Return the misfits that may have been there besides the white noise of what is left."""
    size = float(np.hypot(model.sigma_ou, model.sigma_white))
    return [replace(model, sigma_ou=share * size, length_s=span * span_s) for span in SPANS for share in SHARES]


def _sum(parts: Sequence[tuple[float, FloatArray]], prior: FloatArray) -> tuple[float, FloatArray]:
    return sum((d for d, _ in parts), 0.0), sum((p for _, p in parts), prior)


def _average(options: Sequence[ResidualNoise], shares: FloatArray) -> ExpectedNoise:
    """Return the mean covariance; parts of one length are one part."""
    variances: dict[float, float] = {}
    for model, share in zip(options, shares.tolist(), strict=True):
        if share < LEAST_LIKELY:
            continue
        variances[model.length_s] = variances.get(model.length_s, 0.0) + share * model.sigma_ou**2
    return ExpectedNoise(options[0].sigma_white ** 2, tuple((v, length) for length, v in variances.items() if v > 0.0))


def _told(left: Sequence[Leftover], prior: FloatArray, models: Sequence[ResidualNoise]) -> FloatArray:
    """Return the combinations of unknowns that are told, each to about one, and the residual: (n_unknowns + 1, n_told + 1)."""
    white = [
        replace(model, sigma_ou=0.0, sigma_white=float(np.hypot(model.sigma_ou, model.sigma_white))) for model in models
    ]
    _, products = _sum([part.weigh(model) for part, model in zip(left, white, strict=True)], prior)
    directions = told_directions(products[:-1, :-1], UNTOLD)
    turned = np.zeros((directions.shape[0] + 1, directions.shape[1] + 1))
    turned[:-1, :-1], turned[-1, -1] = directions, 1.0
    return turned


def told_directions(hessian: FloatArray, least: float) -> FloatArray:
    """Return combinations of unknowns that a Hessian tells independently and to one each, (n_unknowns, n_told).

    Those that it tells less than ``least`` of what it tells the best, each unknown counted in its own unit, are left out.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    told, directions = np.linalg.eigh(hessian * scale[:, None] * scale)
    kept = told > least * told[-1]
    return np.asarray(scale[:, None] * directions[:, kept] / np.sqrt(told[kept]))
