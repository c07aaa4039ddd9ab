"""A declared network, with radiation and whatever effects it carries, as the linearised plain arrays of this room."""

from collections.abc import Callable

import numpy as np

from twin_core._typing import FloatArray
from twin_core.latent_force.linearised import Linearised
from twin_core.network.model import Network
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.stages import balance_along


def grid_times_s(forcing: Forcing) -> FloatArray:
    """Return the ends of all steps with the start in front, (n_steps + 1,)."""
    return np.concatenate([[forcing.start_s], forcing.stage_time_s[:, 1]])


def on_grid(forcing: Forcing, samples: FloatArray) -> FloatArray:
    """Return samples (n_samples, n_sensors) on the grid of all steps, NaN in between, (n_steps + 1, n_sensors)."""
    out = np.full((forcing.n_steps + 1, samples.shape[1]), np.nan)
    out[forcing.sample_step] = samples
    return out


def linearise_network(network: Network, forcing: Forcing) -> Callable[[FloatArray], Linearised]:
    """Return the function that linearises a network about temperatures, for :func:`smooth_extended`.

    The balance is evaluated at the begin and the end of each step, between which inputs are held or linear.

    Parameters
    ----------
    network
        At its present parameter values.
    forcing
        Steps, inputs and boundaries.

    Returns
    -------
    callable
        Temperatures (n_steps + 1, n_nodes) on the grid of steps -> network about them.
    """
    values = network.parameters.values

    def about(temperatures_K: FloatArray) -> Linearised:
        n_steps, n = forcing.n_steps, temperatures_K.shape[1]
        stages = np.stack([temperatures_K[:-1], temperatures_K[1:]], axis=1)
        balance = balance_along(network, values, forcing, stages, 0, n_steps)
        rate = balance.rate_K_per_s.reshape(n_steps, 2, n)
        jacobian = balance.jacobian_per_s.reshape(n_steps, 2, n, n)
        capacity = balance.capacity_J_per_K.reshape(n_steps, 2, n).mean(axis=1)
        return Linearised.about(grid_times_s(forcing), temperatures_K, rate, jacobian, capacity)

    return about
