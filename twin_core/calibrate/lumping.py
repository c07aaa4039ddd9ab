"""What a lumped network cannot follow: small differences between a sensor and its node that go along with the temperatures.

A sensor does not sit where its node has its mean temperature. What it reads beside that follows the temperatures and the
heat into its node: a discrepancy of known shape and small size (Kennedy and O'Hagan, J. R. Stat. Soc. B 63, 2001), integrated
out wherever models are compared, so that it is never worth a name.
"""

from dataclasses import replace

import numpy as np

from twin_core._typing import FloatArray
from twin_core.calibrate.latent_heat import NO_HEAT_W, HeatFit, whiten
from twin_core.calibrate.problem import Problem, Segment
from twin_core.calibrate.starting import filled_columns

N_COMPONENTS = 3
"""Principal components of the measured temperatures that a discrepancy may follow."""

NOISE_SHARE, SPREAD_SHARE = 0.3, 0.01
"""Size of the discrepancy of a reading: at most so much of its noise, and of the spread of its temperature."""

HEAT_SHARES = (1.0, 0.3, 0.1)
"""Sizes of the undeclared heat beside it, as shares of the fitted one: the likeliest counts."""


def lumping_shapes(problem: Problem) -> tuple[FloatArray, ...]:
    """Return the shapes of the discrepancy per segment, (n_samples, n_sensors, n_shapes) in K at one standard deviation.

    Each shape moves one sensor: by a principal component of all measured temperatures, or by a heat input of its node.
    """
    n_sensors = problem.noise_K.size
    measured = np.concatenate([segment.measured_K for segment in problem.segments])
    size_K = np.minimum(NOISE_SHARE * problem.noise_K, SPREAD_SHARE * np.nan_to_num(np.nanstd(measured, axis=0)))
    drivers = [_drivers(problem, segment) for segment in problem.segments]
    blocks: list[list[FloatArray]] = [[] for _ in problem.segments]
    for s in range(n_sensors):
        together = np.concatenate([each[s] for each in drivers])
        centre, scale = together.mean(axis=0), together.std(axis=0)
        moving = scale > 1e-9
        for block, each in zip(blocks, drivers, strict=True):
            shapes = ((each[s] - centre) / np.where(moving, scale, 1.0))[:, moving]
            full = np.zeros((shapes.shape[0], n_sensors, shapes.shape[1]))
            full[:, s] = size_K[s] / np.sqrt(max(shapes.shape[1], 1)) * shapes
            block.append(full)
    return tuple(np.concatenate(block, axis=2) for block in blocks)


def _drivers(problem: Problem, segment: Segment) -> list[FloatArray]:
    """Return what the discrepancy of each sensor may follow, (n_samples, n_drivers) in any unit."""
    network = problem.network
    filled = filled_columns(network, segment.record.time_s, segment.measured_K, None)[:, np.unique(network.sensor_node)]
    left, singular, _ = np.linalg.svd(filled - filled.mean(axis=0), full_matrices=False)
    components = (left * singular)[:, :N_COMPONENTS]
    step = np.maximum(segment.forcing.sample_step - 1, 0)
    drivers = []
    for node in network.sensor_node:
        inputs = [load.channel for load in network.spec.loads if load.node == network.nodes[node]]
        heats = [segment.forcing.inputs[channel][step, 0] for channel in inputs if channel in segment.forcing.inputs]
        drivers.append(np.column_stack([components, *heats]))
    return drivers


def log_likelihood_beside_lumping(fit: HeatFit) -> float:
    """Return the log-likelihood of the readings at the parameters of a fit, the discrepancy integrated out."""
    return max(_at(fit, share) for share in HEAT_SHARES)


def gain_of_latent_heat(fit: HeatFit) -> float:
    """Return the log-likelihood that undeclared heat adds to a fit, in nats: next to nothing where nothing is missing."""
    none = replace(fit, latent=replace(fit.latent, std_W=np.full_like(fit.latent.std_W, NO_HEAT_W)))
    return log_likelihood_beside_lumping(fit) - _at(none, 1.0)


def _at(fit: HeatFit, share: float) -> float:
    """Return the log-likelihood at a share of the fitted heat.

    With whitened residual r and shapes B: ln p = ln p(r) + 1/2 g' M^-1 g - 1/2 ln det M, M = I + B'B, g = B'r (Woodbury).
    """
    latent = replace(fit.latent, std_W=share * fit.latent.std_W)
    shapes = lumping_shapes(fit.problem)
    gram, total = np.zeros((shapes[0].shape[2] + 1,) * 2), 0.0
    for nominal, block in zip(fit.nominals, shapes, strict=True):
        columns = np.concatenate([block, nominal.residual_K[:, :, None]], axis=2)
        whitened, log_det = whiten(fit.problem, latent, nominal, columns)
        rows = whitened.reshape(-1, columns.shape[2])
        with np.errstate(over="ignore", invalid="ignore"):  # a linearisation that ran away is as unlikely as can be
            gram += rows.T @ rows
        total -= 0.5 * (log_det + int(nominal.segment.valid.sum()) * np.log(2.0 * np.pi))
    if not np.isfinite(gram).all():
        return -np.inf
    factor = np.linalg.cholesky(np.eye(gram.shape[0] - 1) + gram[:-1, :-1])
    along = np.linalg.solve(factor, gram[:-1, -1])
    return float(total + 0.5 * (along @ along - gram[-1, -1]) - np.log(np.diag(factor)).sum())
