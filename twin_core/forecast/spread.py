"""How far readings may lie from the rollout although the inputs are as given: state, parameters, misfit, noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.calibrate.result import CalibratedModel
from twin_core.effects.base import Beyond
from twin_core.network.model import Network
from twin_core.simulate.extrapolation import extrapolated_variance_K2
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import Rollout

DRAWS = 512
"""Paths that are drawn: a share of 0.9 is then known to 0.013."""
MOST_DRAWN = 4_000_000
"""Numbers of all drawn paths together; between the instants that are kept for it they are taken to be smooth."""


@dataclass(frozen=True)
class Spread:
    """Readings about the rollout.

    Attributes
    ----------
    variance_K2 : (n_times, n_sensors)
        Noise included.
    kept : (n_kept,)
        Instants at which paths are drawn, evenly among those wanted.
    paths_K : (DRAWS, n_kept, n_sensors)
        Paths about the rollout, noise not included.
    """

    variance_K2: FloatArray
    kept: IntArray
    paths_K: FloatArray


def spread(
    model: CalibratedModel,
    network: Network,
    forcing: Forcing,
    path: Rollout,
    state_covariance_K2: FloatArray,
    time_s: FloatArray,
    wanted: IntArray,
    beyond: Sequence[Beyond],
) -> Spread:
    """Return variance of, and paths through, what is uncertain apart from the inputs.

    Parameters
    ----------
    model, network, forcing, path
        A converged rollout over ``time_s``, (n_times,).
    state_covariance_K2 : (n_nodes, n_nodes)
        Where it starts.
    wanted : (n_wanted,)
        Positions among ``time_s`` of the instants that are asked for.
    beyond
        Where effects leave what they were learned from.
    """
    n_free, n_nodes, n_sensors = int(network.parameters.free_index.size), len(network.nodes), len(model.spec.sensors)
    starts = np.hstack([np.zeros((n_nodes, n_free)), np.eye(n_nodes)])
    covariance = np.zeros((n_free + n_nodes, n_free + n_nodes))
    if model.free_names:  # a method may state no covariance
        covariance[:n_free, :n_free] = model.covariance
    covariance[n_free:, n_free:] = state_covariance_K2
    stride = 1 + wanted.size * n_sensors * DRAWS // MOST_DRAWN
    kept = wanted[stride - 1 :: stride] if wanted.size >= stride else wanted[-1:]
    rng = np.random.default_rng(0)
    drawn = _root(covariance) @ rng.standard_normal((covariance.shape[0], DRAWS))
    variances, lines = [], []
    for window, block in sensitivities(network, network.parameters.values, forcing, path, starts, network.sensor_node):
        variances.append(((block @ covariance) * block).sum(axis=-1))
        inside = kept[(kept >= window.start) & (kept < window.stop)]
        lines.append(block[inside - window.start] @ drawn)
    paths = np.concatenate(lines).transpose(2, 0, 1)
    outside = extrapolated_variance_K2(network, beyond, forcing, path, network.sensor_node)
    paths += rng.standard_normal((DRAWS, 1, 1)) * np.sqrt(outside[kept])
    misfit = np.array([model.misfit_K[s] for s in model.spec.sensors])
    length = np.maximum(np.array([model.misfit_length_s[s] for s in model.spec.sensors]), 1e-9)
    lead = time_s - time_s[0]
    paths += _misfit_paths(rng, misfit, length, lead[kept])
    grown = misfit**2 * (1.0 - np.exp(-2.0 * lead[:, None] / length))
    return Spread(np.concatenate(variances) + outside + grown + model.noise_vector_K() ** 2, kept, paths)


def _root(covariance: FloatArray) -> FloatArray:
    """Return R with R R^T the covariance, which may be singular."""
    size, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(size, 0.0)))


def _misfit_paths(rng: np.random.Generator, std: FloatArray, length_s: FloatArray, lead_s: FloatArray) -> FloatArray:
    """Return Ornstein-Uhlenbeck paths that start from zero, (DRAWS, n_times, n_sensors)."""
    keep = np.exp(-np.diff(lead_s, prepend=0.0)[:, None] / length_s)
    shocks = rng.standard_normal((lead_s.size, DRAWS, std.size)) * (std * np.sqrt(1.0 - keep**2))[:, None, :]
    now = np.zeros((DRAWS, std.size))
    for k in range(lead_s.size):
        now = keep[k] * now + shocks[k]
        shocks[k] = now
    return shocks.transpose(1, 0, 2)
