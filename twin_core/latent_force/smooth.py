"""Missing heat as a function of time: the smoothed latent forces, with their band."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.gp.checked import positive
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.smoother import smooth
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel

SAME_K = 1e-6
"""The extended form has converged when no smoothed temperature moves by more."""


@dataclass(frozen=True)
class LatentForce:
    """Smoothed forces and temperatures, given all samples.

    Attributes
    ----------
    time_s : (n_times,)
    nodes
        Node of each force.
    mean_W, std_W : (n_times, n_forces)
        Heat into the node, positive when it warms.
    force_cov_W2 : (n_times, n_forces, n_forces)
    temperature_K, temperature_std_K : (n_times, n_nodes)
    cross_cov_KW : (n_times, n_nodes, n_forces)
        Cov(T, force).
    log_likelihood
        ln p(y | parameters).
    nis : (n_times,)
        Normalised innovation squared of the filter.
    n_linearisations
        How often the network was linearised.
    converged
        Whether the last linearisation changed nothing.
    """

    time_s: FloatArray
    nodes: tuple[int, ...]
    mean_W: FloatArray
    std_W: FloatArray
    force_cov_W2: FloatArray
    temperature_K: FloatArray
    temperature_std_K: FloatArray
    cross_cov_KW: FloatArray
    log_likelihood: float
    nis: FloatArray
    n_linearisations: int = 1
    converged: bool = True


def smooth_force(model: ForceModel, observations: FloatArray, values: FloatArray) -> LatentForce:
    """Smooth the latent forces at given parameters.

    Parameters
    ----------
    model
        Network, forces, sensors.
    observations : (n_times, n_sensors)
        Measured temperatures in K; NaN where missing.
    values : (n_free,)
        Parameters in the order of ``model.names``, positive.

    Raises
    ------
    ModelError
        A shape is wrong or a parameter is not positive.
    """
    at = positive(values, model.names)
    linear = model.linear_model(at)
    filtered = kalman_filter(linear, observations)
    smoothed = smooth(linear, filtered)
    rows, n = model.force_rows(at), model.n_nodes
    forces = np.einsum("fi,kij,gj->kfg", rows, smoothed.cov, rows, optimize=True)
    return LatentForce(
        time_s=model.network(at[list(model.network_index)]).time_s,
        nodes=tuple(force.node for force in model.forces),
        mean_W=smoothed.mean @ rows.T,
        std_W=np.sqrt(np.maximum(np.einsum("kff->kf", forces), 0.0)),
        force_cov_W2=forces,
        temperature_K=smoothed.mean[:, :n],
        temperature_std_K=np.sqrt(np.maximum(smoothed.variance[:, :n], 0.0)),
        cross_cov_KW=smoothed.cov[:, :n] @ rows.T,
        log_likelihood=filtered.log_likelihood,
        nis=filtered.nis,
    )


def smooth_extended(
    model: ForceModel,
    relinearise: Callable[[FloatArray], Linearised],
    observations: FloatArray,
    values: FloatArray,
    *,
    max_linearisations: int = 10,
) -> LatentForce:
    """Smooth with the network linearised again about its own smoothed temperatures (iterated extended smoother).

    Parameters
    ----------
    model
        Its network is the first linearisation.
    relinearise
        Temperatures (n_times, n_nodes) -> network about them.
    observations : (n_times, n_sensors)
    values : (n_free,)
        The network must not depend on them.
    max_linearisations
        Where to stop; the result says whether it had converged.

    Raises
    ------
    ModelError
        As :func:`smooth_force`; or the network has parameters of its own.
    """
    if max_linearisations < 1:
        raise ModelError(f"max_linearisations must be at least 1, it is {max_linearisations}")
    if model.network_index:
        raise ModelError("the extended smoother takes a network without free parameters")
    found = smooth_force(model, observations, values)
    for count in range(2, max_linearisations + 1):
        network = relinearise(found.temperature_K)
        again = smooth_force(_with_network(model, network), observations, values)
        moved = float(np.abs(again.temperature_K - found.temperature_K).max())
        found = replace(again, n_linearisations=count, converged=moved < SAME_K)
        if found.converged:
            break
    return found


def _with_network(model: ForceModel, network: Linearised) -> ForceModel:
    return replace(model, network=lambda _: network)
