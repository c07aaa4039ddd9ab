"""How far readings may lie from the rollout although the inputs are as given: state, parameters, misfit, noise.

The misfit of a calibration is how far readings lie from a rollout that nothing corrects: an Ornstein-Uhlenbeck process M of
each sensor. A state that follows the readings has taken M(0) for a temperature, and the network forgets it at its own pace,
not at that of the misfit. So the rollout misses M(t) - Phi(t) M(0), where Phi is how a start moves the readings: nothing at
first, and the whole misfit once the start is forgotten, however slowly M itself moves.

The filter has run with the parameters that it was given, so errors of its state depend on theirs: hidden nodes have been moved
until the model follows the readings. The two largely cancel, as long as the inputs are like those before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import Float32Array, FloatArray, IntArray
from twin_core.assimilate import process_noise_K2_per_s
from twin_core.calibrate.result import CalibratedModel
from twin_core.effects.base import Beyond
from twin_core.forecast.bands import normals
from twin_core.network.model import Network
from twin_core.simulate.extrapolation import extrapolated_variance_K2
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import Rollout

DRAWS = 512
"""Paths that are drawn: a share of 0.9 is then known to 0.013."""
MOST_DRAWN = 1_000_000
"""Numbers of all drawn paths together; between the instants that are kept for it they are taken to be smooth. Where a path of 285
minutes keeps every second one, its band changes by less than other draws change it, 2 %."""
DOUBLINGS = 20
"""A filter is taken to have run for 2^20 samples, the longest archive that the service is measured with. It bounds the error of a
node that nearly nothing damps. On the flight sets 2^10 and 2^30 samples give the same bands, 2^8 within 1e-6, 2^5 within 13 %.
"""


@dataclass(frozen=True)
class Spread:
    """Readings about the rollout.

    Attributes
    ----------
    variance_K2 : (n_wanted, n_sensors)
        Noise included.
    kept : (n_kept,)
        Instants at which paths are drawn, evenly among those wanted: positions there.
    paths_K : (n_kept, n_sensors, DRAWS)
        Paths about the rollout, noise not included: each sensor's are drawn rightly, what two have in common is not.
    """

    variance_K2: FloatArray
    kept: IntArray
    paths_K: Float32Array


def spread(
    model: CalibratedModel,
    network: Network,
    forcing: Forcing,
    path: Rollout,
    state_covariance_K2: FloatArray,
    time_s: FloatArray,
    wanted: IntArray,
    beyond: Sequence[Beyond],
    sampling_s: float,
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
    sampling_s
        Between two readings that the filter has followed.
    """
    n_free, n_nodes, n_sensors = int(network.parameters.free_index.size), len(network.nodes), len(model.spec.sensors)
    by_parameters = state_by_parameters(model, network, forcing, path, state_covariance_K2, sampling_s)
    starts = np.hstack([by_parameters, np.eye(n_nodes)])
    covariance = np.zeros((n_free + n_nodes, n_free + n_nodes))
    if model.free_names:  # a method may state no covariance
        covariance[:n_free, :n_free] = model.covariance
    covariance[n_free:, n_free:] = state_covariance_K2
    stride = 1 + wanted.size * n_sensors * DRAWS // MOST_DRAWN
    kept = np.arange(wanted.size)[min(stride, wanted.size) - 1 :: stride]
    rng = np.random.default_rng(0)
    drawn = (_root(covariance) @ rng.standard_normal((covariance.shape[0], DRAWS))).astype(np.float32)
    misfit = np.array([model.misfit_K[s] for s in model.spec.sensors])
    length = np.maximum(np.array([model.misfit_length_s[s] for s in model.spec.sensors]), 1e-9)
    lead = time_s[wanted] - time_s[0]
    forcing = replace(forcing, sample_step=forcing.sample_step[wanted])
    now_K = (misfit[:, None] * rng.standard_normal((n_sensors, DRAWS))).astype(np.float32)
    drawn = np.vstack([drawn, now_K])
    variance = np.empty((wanted.size, n_sensors))
    paths = np.empty((kept.size, n_sensors, DRAWS), dtype=np.float32)
    done = 0
    for window, block in sensitivities(network, network.parameters.values, forcing, path, starts, network.sensor_node):
        variance[window] = ((block @ covariance) * block).sum(axis=-1)
        inside = kept[(kept >= window.start) & (kept < window.stop)] - window.start
        lines = paths[done : done + inside.size]
        done += inside.size
        moved_by = block[inside]
        if misfit.any():
            left = _misfit_left(network, block[:, :, n_free:], np.exp(-lead[window, None] / length))
            variance[window] += left**2 @ misfit**2
            moved_by = np.concatenate([moved_by, left[inside]], axis=2)
        np.matmul(_rows(moved_by), drawn[: moved_by.shape[2]], out=lines.reshape(-1, DRAWS))
    outside = extrapolated_variance_K2(network, beyond, forcing, path, network.sensor_node)
    if outside.any():
        paths += np.sqrt(outside[kept], dtype=np.float32)[:, :, None] * rng.standard_normal(DRAWS, dtype=np.float32)
    if misfit.any():
        _add_misfit(paths, misfit, length, lead[kept])
    grown = misfit**2 * (1.0 - np.exp(-2.0 * lead[:, None] / length))
    return Spread(variance + outside + grown + model.noise_vector_K() ** 2, kept, paths)


def state_by_parameters(
    model: CalibratedModel,
    network: Network,
    forcing: Forcing,
    path: Rollout,
    state_covariance_K2: FloatArray,
    sampling_s: float,
) -> FloatArray:
    """Return d filtered state / d free parameter, (n_nodes, n_free), of a filter that has long run under present inputs.

    It is the fixed point of S = (I - K H) (Phi S + G), Phi and G how state and parameters move a state until the next readings,
    K the gain (Schmidt 1966: a filter that considers parameters which it does not estimate).

    Parameters
    ----------
    model, network, forcing, path
        A converged rollout from the present.
    state_covariance_K2 : (n_nodes, n_nodes)
        Of the filtered state.
    sampling_s
        Between two readings. Where the steps of the rollout are longer, as many readings as come within one are taken together.
    """
    n_free, n_nodes = int(network.parameters.free_index.size), len(network.nodes)
    if forcing.n_steps == 0 or n_free == 0:
        return np.zeros((n_nodes, n_free))
    elapsed_s = np.cumsum(forcing.step_s)
    n_steps = int(np.argmin(np.abs(elapsed_s - sampling_s))) + 1
    ahead_s = float(elapsed_s[n_steps - 1])
    opening = replace(path, stages_K=path.stages_K[:n_steps])
    starts = np.hstack([np.zeros((n_nodes, n_free)), np.eye(n_nodes)])
    nodes = np.arange(n_nodes)
    values = network.parameters.values
    blocks = sensitivities(network, values, forcing.opening(n_steps), opening, starts, nodes)
    block = np.concatenate([b for _, b in blocks])[-1]
    by_parameter, by_state = block[:, :n_free], block[:, n_free:]
    read = np.zeros((network.sensor_node.size, n_nodes))
    read[np.arange(network.sensor_node.size), network.sensor_node] = 1.0
    process_K2 = process_noise_K2_per_s(model, network, sampling_s) * ahead_s
    predicted_K2 = by_state @ state_covariance_K2 @ by_state.T + np.diag(process_K2)
    noise_K2 = model.noise_vector_K() ** 2 * min(sampling_s / ahead_s, 1.0)
    gain = np.linalg.solve(read @ predicted_K2 @ read.T + np.diag(noise_K2), read @ predicted_K2).T
    kept = np.eye(n_nodes) - gain @ read
    found: FloatArray = kept @ by_parameter
    carried: FloatArray = kept @ by_state
    for _ in range(DOUBLINGS):
        found = found + carried @ found
        carried = carried @ carried
    return found


def _rows(block: FloatArray) -> Float32Array:
    """Return (..., n_columns) as rows."""
    return block.reshape(-1, block.shape[-1]).astype(np.float32)


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


def _add_misfit(paths_K: Float32Array, std: FloatArray, length_s: FloatArray, lead_s: FloatArray) -> None:
    """Add Ornstein-Uhlenbeck paths that start from zero, all sensors' of the same shocks."""
    keep = np.exp(-np.diff(lead_s, prepend=0.0)[:, None] / length_s)
    size = (std * np.sqrt(1.0 - keep**2)).astype(np.float32)[:, :, None]
    kept_share = keep.astype(np.float32)[:, :, None]
    shocks = normals(2, lead_s.size, DRAWS)
    now = np.zeros((std.size, DRAWS), dtype=np.float32)
    for k in range(lead_s.size):
        now *= kept_share[k]
        now += size[k] * shocks[k]
        paths_K[k] += now
