"""One step of the scheme from many states at once: what a filter needs between two samples."""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray
from twin_core.network.model import Network
from twin_core.network.storage import to_enthalpy_K, to_temperatures_K
from twin_core.simulate.derivatives import transitions
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.kernels import march
from twin_core.simulate.rollout import LIMIT_K
from twin_core.simulate.splitting import Split, anchors, less_modes, limits
from twin_core.simulate.stages import balance_along

N_NEWTON = 12
TOLERANCE_K = 1e-6


@dataclass(frozen=True)
class Steps:
    """Every step of a forcing taken from its own start.

    Attributes
    ----------
    ends_K : (n_steps, n_nodes)
    stages_K : (n_steps, 2, n_nodes)
        Begin and end of each step.
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
    own = values[network.capacity_index]
    stages_K = np.repeat(starts_K[:, None], 2, axis=1) if near_K is None else near_K.copy()
    stages_K[:, 0] = starts_K
    forward, response = np.empty((n_steps, n_nodes, n_nodes)), np.empty((n_steps, n_nodes, n_nodes))
    for first, last, about_K in anchors(starts_K):
        split = Split.at(network, values, forcing, first, last, about_K)
        more = 0.0 if extra_W is None else (extra_W[first:last] / own)[:, None]
        stages_K[first:last], kicks = take_steps(split, stages_K[first:last], more)
        balance = balance_along(network, values, forcing, stages_K[first:last], first, last, only=split.steady)
        entries = less_modes(balance.jacobian, split.slope_W_per_K, own)
        begins = to_enthalpy_K(network, values, np.ascontiguousarray(starts_K[first:last]))
        ahead, by_rate = transitions(forcing.step_s[first:last], split.modes, *entries, begins, split.relays, kicks)
        slope = balance.slope.reshape(-1, 2, n_nodes)
        forward[first:last] = slope[:, 1, :, None] * ahead / slope[:, 0, None, :]
        response[first:last] = slope[:, 1, :, None] * by_rate / own
    return Steps(stages_K[:, 1], stages_K, forward, response)


def take_steps(split: Split, stages_K: FloatArray, more: FloatArray | float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Return the states at both ends of the steps of a stretch, each from its own start, and what relays did (``march``).

    Parameters
    ----------
    split
        The balance of the stretch.
    stages_K : (n_steps, 2, n_nodes)
        The starts, and ends close by.
    more : (n_steps, 1, n_nodes)
        Adds to the rates.
    """
    network, values = split.network, split.values
    lowest, highest = limits(network, values, LIMIT_K)
    step_s = split.forcing.step_s[split.first : split.last]
    stages = to_enthalpy_K(network, values, stages_K)
    kicks = np.zeros((step_s.size, 0, 0))
    for _ in range(N_NEWTON):
        left, given = split.remainder(split.beside(stages_K, split.first, split.last), stages, split.first, split.last)
        starts = np.ascontiguousarray(stages[:, 0])
        solved, kicks, _ = march(step_s, split.modes, left, split.relays, given + more, starts, stages, lowest, highest)
        change = float(np.abs(solved - stages).max(initial=0.0))
        stages = solved
        stages_K = to_temperatures_K(network, values, solved, stages_K, LIMIT_K)
        if not split.others or not change >= TOLERANCE_K:
            break
    return stages_K, kicks
