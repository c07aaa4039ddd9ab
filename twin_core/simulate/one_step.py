"""One step of the scheme from many states at once: what a filter needs between two samples."""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray
from twin_core.network.model import Network
from twin_core.network.storage import store, to_enthalpy_K, to_temperatures_K
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.kernels import GAMMA
from twin_core.simulate.rollout import LIMIT_K
from twin_core.simulate.stages import balance_along

N_NEWTON = 12


@dataclass(frozen=True)
class Steps:
    """Every step of a forcing taken from its own start.

    Attributes
    ----------
    ends_K : (n_steps, n_nodes)
    stages_K : (n_steps, 2, n_nodes)
    transition : (n_steps, n_nodes, n_nodes)
        d end / d start.
    heat_response_K_per_W : (n_steps, n_nodes, n_nodes)
        d end / d extra heat into each node, held over the step.
    """

    ends_K: FloatArray
    stages_K: FloatArray
    transition: FloatArray
    heat_response_K_per_W: FloatArray


def one_step(
    network: Network,
    values: FloatArray,
    forcing: Forcing,
    starts_K: FloatArray,
    extra_W: FloatArray | None = None,
    *,
    near_K: FloatArray | None = None,
) -> Steps:
    """Advance every step of a forcing from its own start.

    Parameters
    ----------
    network, values
        The model.
    forcing
        n_steps steps with their inputs.
    starts_K : (n_steps, n_nodes)
        State at the beginning of each step.
    extra_W : (n_steps, n_nodes)
        Heat beyond the network's terms, held over each step; none by default.
    near_K : (n_steps, 2, n_nodes)
        Stage states close by, to save iterations.

    Returns
    -------
    Steps
        Newton's method to 1e-6 K, all steps at once.
    """
    n_steps, n_nodes = starts_K.shape
    temperatures = np.repeat(starts_K[:, None], 2, axis=1) if near_K is None else near_K
    starts, stages = to_enthalpy_K(network, values, starts_K), to_enthalpy_K(network, values, temperatures)
    identity = np.eye(n_nodes)
    scaled = GAMMA * forcing.step_s[:, None, None]
    ratio = (1.0 - GAMMA) / GAMMA
    inverse = np.broadcast_to(identity, (n_steps, 2, n_nodes, n_nodes))
    own, slope = values[network.capacity_index], np.ones((n_steps, n_nodes))
    for _ in range(N_NEWTON):
        balance = balance_along(network, values, forcing, temperatures, 0, n_steps)
        jacobian = balance.jacobian.dense().reshape(n_steps, 2, n_nodes, n_nodes)
        rate = (balance.heat_W / own).reshape(n_steps, 2, n_nodes)
        if extra_W is not None:
            rate = rate + extra_W[:, None] / own
        constant = rate - np.einsum("ksij,ksj->ksi", jacobian, stages)
        inverse = np.linalg.inv(identity - scaled[:, None] * jacobian)
        first = np.einsum("kij,kj->ki", inverse[:, 0], starts + scaled[:, 0] * constant[:, 0])
        middle = starts + ratio * (first - starts) + scaled[:, 0] * constant[:, 1]
        solved = np.stack([first, np.einsum("kij,kj->ki", inverse[:, 1], middle)], axis=1)
        change = float(np.abs(solved - stages).max(initial=0.0))
        temperatures = np.clip(to_temperatures_K(network, values, solved, temperatures, LIMIT_K), *LIMIT_K)
        stages = solved if network.capacities else temperatures
        slope = balance.slope[1::2]
        if change < 1e-6:
            break
    transition = inverse[:, 1] @ (identity + ratio * (inverse[:, 0] - identity))
    response = (ratio * scaled * inverse[:, 1] @ inverse[:, 0] + scaled * inverse[:, 1]) / own
    if network.capacities:
        transition = slope[:, :, None] * transition / store(network, values, starts_K).slope[:, None, :]
        response = slope[:, :, None] * response
    return Steps(temperatures[:, 1], temperatures, transition, response)
