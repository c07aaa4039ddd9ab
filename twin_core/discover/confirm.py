"""Confirmation: a full refit with an effect in place, its evidence, and its error on blocks that it was not fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from twin_core._typing import FloatArray
from twin_core.calibrate.latent_heat import HeatFit, fit_with_latent_heat
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.residual_noise import stacked_jacobian
from twin_core.calibrate.second_order import Calibration, from_heat_fit
from twin_core.effects.base import Effect
from twin_core.network.model import build_network

N_BLOCKS = 8
"""Blocks of the training record that are predicted from the others."""


@dataclass(frozen=True)
class Trial:
    """A model with some effects, fitted in the presence of latent heat, and what speaks for it.

    Attributes
    ----------
    effects
        At their fitted values.
    fit
        Parameters, latent heat and likelihood.
    max_step_s
        Longest time step.
    near
        Open-loop optima of the same problem found otherwise.
    """

    effects: tuple[Effect, ...]
    fit: HeatFit
    max_step_s: float
    near: tuple[Optimum, ...] = ()

    @cached_property
    def calibration(self) -> Calibration:
        """The same model calibrated on open-loop trajectories."""
        return from_heat_fit(self.fit, self.max_step_s, near=self.near)

    @cached_property
    def block_errors(self) -> FloatArray:
        """Sum of squared weighted errors on each block predicted from the others, (n_blocks,)."""
        return blocked_errors(self.calibration)

    @property
    def n_samples(self) -> int:
        """Number of readings that took part."""
        return int(sum(n.segment.valid.sum() for n in self.fit.nominals))


def fitted_effects(effects: Sequence[Effect], values: dict[str, float]) -> tuple[Effect, ...]:
    """Return effects at the values of a fitted network."""
    return tuple(effect.at_parameters(values) for effect in effects)


def blocked_errors(calibration: Calibration) -> FloatArray:
    """Return the error on each of ``N_BLOCKS`` blocks of the record, predicted by parameters fitted to the others.

    At the optimum with Hessian H, leaving out block b moves the parameters by -(H - J_b' J_b)^-1 J_b' r_b, so that the
    residual on b becomes r_b + J_b (H - J_b' J_b)^-1 J_b' r_b: exact for a linear model, no refit needed.
    """
    problem, unknowns = calibration.problem, calibration.optimum.unknowns
    jacobian = stacked_jacobian(problem, problem.jacobian_blocks(unknowns, calibration.optimum.fit))
    residual = np.concatenate(calibration.residuals) / problem.noise_K
    jacobian = jacobian / problem.noise_K[None, :, None]
    hessian, _ = problem.normal_equations(unknowns, calibration.optimum.fit)
    edges = np.linspace(0, residual.shape[0], N_BLOCKS + 1).astype(int)
    errors = np.zeros(N_BLOCKS)
    for b, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        valid = np.isfinite(residual[first:last])
        rows, left = jacobian[first:last][valid], residual[first:last][valid]
        rest = hessian - rows.T @ rows
        scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
        inverse = np.linalg.pinv(rest * scale[:, None] * scale, rcond=1e-10, hermitian=True)
        move = scale * (inverse @ (scale * (rows.T @ left)))
        predicted = left + rows @ move
        errors[b] = float(predicted @ predicted)
    return errors


def try_effects(base: Trial, effects: Sequence[Effect], *, n_passes: int = 3) -> Trial:
    """Return the trial of a set of effects, fitted with all parameters from a trial close by.

    Parameters
    ----------
    base
        Where to start from: the same telemetry, with or without some of the effects.
    effects
        All effects of the new trial, at their starting values.
    n_passes
        Passes of the fit at most: few to rank, many to settle.
    """
    problem = extended(base.fit.problem, effects)
    names = base.fit.problem.network.parameters.free_names
    before = dict(zip(names, base.fit.free, strict=True))
    own = {p.name for effect in effects for p in effect.parameters()}
    free = np.array(
        [
            value if name in own else before.get(name, value)
            for name, value in zip(problem.network.parameters.free_names, problem.network.parameters.free, strict=True)
        ]
    )
    fit = fit_with_latent_heat(problem, free, near=base.fit, n_passes=n_passes)
    return Trial(fitted_effects(effects, fit.network.parameters.as_dict()), fit, base.max_step_s)


def extended(declared: Problem, effects: Sequence[Effect]) -> Problem:
    """Return the problem of the declared network with effects; its priors are those of the declaration."""
    before = declared.network
    network = build_network(before.spec, effects, table_knots=before.layout.table_knots)
    own = {p.name for effect in effects for p in effect.parameters()}
    kept = {p.name: p.value for p in before.parameters.parameters if p.name not in own}
    return declared.with_network(network.with_parameters(network.parameters.updated(kept)))


@dataclass(frozen=True)
class Evidence:
    """What the likelihood says for a trial against a simpler one.

    Attributes
    ----------
    log_bayes_factor
        Difference of log evidence (Schwarz), the number of candidates tried counted against it.
    p_value
        Likelihood-ratio test, corrected for the number of candidates (Bonferroni).
    """

    log_bayes_factor: float
    p_value: float


@dataclass(frozen=True)
class Validation:
    """How a trial predicts blocks of the training record that it was not fitted to.

    Attributes
    ----------
    ratio
        Open-loop error after over before (rms).
    blocks_better
        Share of blocks whose error fell.
    """

    ratio: float
    blocks_better: float


def weigh(simple: Trial, rich: Trial, n_tried: int) -> Evidence:
    """Return what the likelihood says for the rich trial, chosen among ``n_tried`` candidates."""
    extra = max(rich.fit.problem.n_free - simple.fit.problem.n_free, 1)
    gain = rich.fit.log_posterior - simple.fit.log_posterior
    penalty = 0.5 * extra * np.log(max(rich.n_samples, 2)) + np.log(max(n_tried, 1))
    p_value = min(1.0, max(n_tried, 1) * float(chi2.sf(2.0 * max(gain, 0.0), extra)))
    return Evidence(float(gain - penalty), p_value)


def validate(simple: Trial, rich: Trial) -> Validation:
    """Return how the rich trial predicts blocks that it was not fitted to, against the simple one."""
    before, after = simple.block_errors, rich.block_errors
    ratio = float(np.sqrt(after.sum() / max(before.sum(), 1e-300)))
    return Validation(ratio, float(np.mean(after < before)))
