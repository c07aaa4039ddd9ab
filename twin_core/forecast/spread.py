"""How far readings may lie from the rollout although the inputs are as given: state, parameters, misfit, noise.

The misfit of a calibration is how far readings lie from a rollout that nothing corrects: an Ornstein-Uhlenbeck process M of
each sensor. A state that follows the readings has taken M(0) for a temperature, and the network forgets it at its own pace,
not at that of the misfit. So the rollout misses M(t) - Phi(t) M(0), where Phi is how a start moves the readings: nothing at
first, and the whole misfit once the start is forgotten, however slowly M itself moves.
"""

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
    misfit = np.array([model.misfit_K[s] for s in model.spec.sensors])
    length = np.maximum(np.array([model.misfit_length_s[s] for s in model.spec.sensors]), 1e-9)
    lead = time_s - time_s[0]
    now_K = misfit[:, None] * rng.standard_normal((n_sensors, DRAWS))
    variances, lines = [], []
    for window, block in sensitivities(network, network.parameters.values, forcing, path, starts, network.sensor_node):
        left = _misfit_left(network, block[:, :, n_free:], np.exp(-lead[window, None] / length))
        variances.append(((block @ covariance) * block).sum(axis=-1) + left**2 @ misfit**2)
        inside = kept[(kept >= window.start) & (kept < window.stop)] - window.start
        lines.append(block[inside] @ drawn + left[inside] @ now_K)
    paths = np.concatenate(lines).transpose(2, 0, 1)
    outside = extrapolated_variance_K2(network, beyond, forcing, path, network.sensor_node)
    paths += rng.standard_normal((DRAWS, 1, 1)) * np.sqrt(outside[kept])
    paths += _misfit_paths(rng, misfit, length, lead[kept])
    grown = misfit**2 * (1.0 - np.exp(-2.0 * lead[:, None] / length))
    return Spread(np.concatenate(variances) + outside + grown + model.noise_vector_K() ** 2, kept, paths)


def _misfit_left(network: Network, by_start: FloatArray, faded: FloatArray) -> FloatArray:
    """Return what each sensor's misfit of the start still does to the readings, (n_times, n_sensors, n_sensors).

    Sensors of one node have given it the mean of theirs. ``by_start`` is (n_times, n_sensors, n_nodes), ``faded``
    (n_times, n_sensors) what is left of the misfits themselves.
    """
    node = network.sensor_node
    return faded[:, :, None] * np.eye(node.size) - by_start[:, :, node] / np.bincount(node)[node]


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
