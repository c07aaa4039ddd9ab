"""The noise that a fit was made from, by restricted likelihood: what the parameters have absorbed of it is not forgotten.

A lumped network is never quite the truth, and its parameters bend until they follow as much of a slow misfit as they can.
What is left then looks whiter and smaller than what bent them. The restricted likelihood (Patterson and Thompson 1971) is
that of the part of the readings which no choice of parameters can follow, so that it counts the freedom that is spent.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from twin_core._typing import FloatArray
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.residual_noise import Whitener
from twin_core.gp.noise_model import ResidualNoise

MOST_ROWS, FEWEST_ROWS, MOST_VALUES = 2000, 100, 12_500_000
"""Longer records are averaged over neighbouring readings: a slow misfit is seen as well, in less time. Where sensors and
unknowns are many, so are records of which all derivatives together would be more than so many, 100 MB."""

MOST_PRODUCTS = 50_000_000
"""Products of columns, 400 MB: where those of every sensor and misfit would be more, neighbouring sensors share a misfit."""

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

    @property
    def misfit(self) -> tuple[float, float] | None:
        """Standard deviation in K and correlation length in s of one part that varies as much and grows as fast as all."""
        if not self.coloured:
            return None
        variance_K2 = sum(v for v, _ in self.coloured)
        return float(np.sqrt(variance_K2)), float(variance_K2 / sum(v / length for v, length in self.coloured))


def no_longer(model: ResidualNoise, span_s: float) -> ResidualNoise:
    """Return a noise that grows as fast and lasts no longer than a record of length ``span_s``, which tells no more of it."""
    if model.length_s <= span_s:
        return model
    return replace(model, sigma_ou=model.sigma_ou * np.sqrt(span_s / model.length_s), length_s=span_s)


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
    left = _leftovers(problem, optimum, whitener, residuals)
    return expected_noise(left, rows.T @ rows, whitener.models, problem.span_s)


def _leftovers(
    problem: Problem, optimum: Optimum, whitener: Whitener, residuals: Sequence[FloatArray]
) -> list[Leftover]:
    """Return what a fit leaves, sensor by sensor, with neighbouring readings of long records averaged."""
    residual = np.concatenate(list(residuals))
    lengths = [segment.record.time_s.size for segment in problem.segments]
    segment_of, first = np.repeat(np.arange(len(lengths)), lengths), np.cumsum([0, *lengths])
    n_sensors, n_unknowns = residual.shape[1], problem.n_unknowns
    most_rows = int(np.clip(MOST_VALUES // (n_sensors * n_unknowns), FEWEST_ROWS, MOST_ROWS))
    found: list[Leftover] = []
    row_of = np.full(residual.shape, -1)  # in which row a reading counts
    for sensor in range(n_sensors):
        valid = whitener.valid[:, sensor]
        together = int(np.ceil(valid.sum() / most_rows))
        seen = [np.flatnonzero((segment_of == s) & valid) for s in range(len(lengths))]
        rows = np.concatenate([own[: own.size // together * together] for own in seen]).reshape(-1, together)
        row_of[rows, sensor] = np.arange(rows.shape[0])[:, None]
        columns = np.zeros((rows.shape[0], n_unknowns + 1))
        columns[:, -1] = residual[rows, sensor].mean(axis=1)
        found.append(Leftover(whitener.time_s[rows].mean(axis=1), columns, together))
    for segment, samples, block in problem.jacobian_stretches(optimum.unknowns, optimum.fit):
        unknowns = np.r_[0 : problem.n_free, problem.start_columns(segment)]
        at = row_of[first[segment] + samples.start : first[segment] + samples.stop]
        for sensor, part in enumerate(found):
            counts = at[:, sensor] >= 0
            if counts.any():
                rows = at[counts, sensor]
                begins = np.flatnonzero(np.diff(rows, prepend=-1))
                sums = np.add.reduceat(block[counts, sensor], begins, axis=0)
                part.columns[np.ix_(rows[begins], unknowns)] += sums / part.together
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
        Noise of what was left, one per sensor; what lasts longer than the segment counts as if it lasted as long.
    span_s
        Length of the longest segment.
    """
    models = [no_longer(model, span_s) for model in models]
    turned = _told(left, prior, models)
    told = [replace(part, columns=part.columns @ turned) for part in left]
    options = [[model, *_misfits(model, span_s)] for model in models]
    groups = _groups(len(left), len(options[0]) * turned.shape[1] ** 2)
    weighed = [[_sum(told[s].weigh(options[s][k]) for s in group) for k in range(len(options[0]))] for group in groups]
    everywhere = [_sum([own[k] for own in weighed], turned.T @ prior @ turned) for k in range(len(options[0]))]
    best = int(np.argmax([restricted_log_likelihood(*total) for total in everywhere]))
    log_det, products = everywhere[best]
    chosen = [best] * len(groups)
    common = first = np.full(len(options[0]), 1.0 / len(options[0]))
    shares = np.zeros((len(groups), first.size))
    for _ in range(SWEEPS):
        for g, own in enumerate(weighed):
            log_det, products = log_det - own[chosen[g]][0], products - own[chosen[g]][1]
            told_by = np.array([restricted_log_likelihood(log_det + d, products + p) for d, p in own])
            shares[g] = common * np.exp(told_by - told_by.max())
            shares[g] /= shares[g].sum()
            chosen[g] = int(np.argmax(shares[g]))
            log_det, products = log_det + own[chosen[g]][0], products + own[chosen[g]][1]
        common = (first + shares.sum(axis=0)) / (1.0 + len(groups))
    return [_average(options[s], share) for group, share in zip(groups, shares, strict=True) for s in group]


def _groups(n_sensors: int, n_products: int) -> list[list[int]]:
    """Return which sensors share a misfit: each has its own unless ``n_products`` of each would be too many."""
    n_groups = int(np.clip(MOST_PRODUCTS // n_products, 1, n_sensors))
    return [group.tolist() for group in np.array_split(np.arange(n_sensors), n_groups)]


def _misfits(model: ResidualNoise, span_s: float) -> list[ResidualNoise]:
    """Return the misfits that may have been there besides the white noise of what is left."""
    size = float(np.hypot(model.sigma_ou, model.sigma_white))
    return [replace(model, sigma_ou=share * size, length_s=span * span_s) for span in SPANS for share in SHARES]


def _sum(parts: Iterable[tuple[float, FloatArray]], prior: FloatArray | float = 0.0) -> tuple[float, FloatArray]:
    """Return the sums of log-determinants and of products, those of the priors added."""
    log_det, products = 0.0, prior
    for d, p in parts:
        log_det, products = log_det + d, products + p
    return log_det, np.asarray(products)


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
    _, products = _sum((part.weigh(model) for part, model in zip(left, white, strict=True)), prior)
    directions = told_directions(products[:-1, :-1], UNTOLD)
    turned = np.zeros((directions.shape[0] + 1, directions.shape[1] + 1))
    turned[:-1, :-1], turned[-1, -1] = directions, 1.0
    return turned


def told_directions(hessian: FloatArray, least: float) -> FloatArray:
    """Return combinations of unknowns that a Hessian tells independently and to one each, (n_unknowns, n_told).

    Those that it tells less than ``least`` of what it tells the best, each unknown counted in its own unit, are left out, and
    so is an unknown of which it tells nothing at all.
    """
    told_of = np.diag(hessian)
    scale = np.where(told_of > 0.0, 1.0 / np.sqrt(np.where(told_of > 0.0, told_of, 1.0)), 0.0)
    told, directions = np.linalg.eigh(hessian * scale[:, None] * scale)
    kept = told > least * told[-1]
    return np.asarray(scale[:, None] * directions[:, kept] / np.sqrt(told[kept]))
