"""Network and forces as one linear system: the one place for signs and the order of states.

states   x = [T_1 ... T_n | block of force 1 | block of force 2 | ...]
dynamics dT/dt = J T + c + C⁻¹ (heat h x of each force into its node),   d block/dt = kernel
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.gp.discretise import distinct_steps
from twin_core.gp.kernels import Block, Kernel, Values
from twin_core.latent_force.linearised import Linearised


@dataclass(frozen=True)
class Force:
    """A latent heat into one node.

    Attributes
    ----------
    node
        Index of the node.
    kernel
        Covariance function, in W.
    index
        Positions of its hyperparameters in the model's vector; forces that share them share positions.
    """

    node: int
    kernel: Kernel
    index: tuple[int, ...]


def step_table(network: Linearised) -> tuple[FloatArray, IntArray]:
    """Return the steps to be discretised and which of them each step uses: few where the network is linear."""
    steps, index = distinct_steps(network.time_s)
    if network.jacobian_per_s.shape[0] == 1 and network.capacity_J_per_K.shape[0] == 1:
        return steps, index
    return steps[index] if index.size else steps, np.arange(index.size, dtype=np.int64)


def augment(
    network: Linearised, forces: Sequence[Force], blocks: Sequence[Block], drift_K2_per_s: FloatArray
) -> tuple[Values, Values]:
    """Return F (1 or n_steps, n_states, n_states) and D (n_states, n_states): heat h x / C enters its node, positive."""
    n = network.n_nodes
    n_states = n + sum(b.observation.size for b in blocks)
    count = max(network.jacobian_per_s.shape[0], network.capacity_J_per_K.shape[0])
    kind = np.result_type(
        network.jacobian_per_s, network.capacity_J_per_K, *(a for b in blocks for a in (b.feedback, b.diffusion))
    )
    feedback, diffusion = np.zeros((count, n_states, n_states), dtype=kind), np.zeros((n_states, n_states), dtype=kind)
    feedback[:, :n, :n] = network.jacobian_per_s
    diffusion[range(n), range(n)] = drift_K2_per_s
    at = n
    for force, block in zip(forces, blocks, strict=True):
        here = slice(at, at + block.observation.size)
        feedback[:, force.node, here] = block.observation / network.capacity_J_per_K[:, force.node, None]
        feedback[:, here, here] = block.feedback
        diffusion[here, here] = block.diffusion
        at = here.stop
    return feedback, diffusion


FEW_DISTINCT = 32
"""Up to so many distinct steps, one matrix product each is quickest; beyond, matrices are gathered step by step."""

GATHERED = 4096
"""Steps whose matrices are gathered at once, to bound memory."""


def drive(hold: Values, ramp: Values, index: IntArray, inputs: Values) -> Values:
    """Return hold u_start + ramp (u_end - u_start) of each step.

    Parameters
    ----------
    hold, ramp : (n_distinct, n_states, n_inputs)
    index : (n_steps,)
    inputs : (n_steps, 2, n_inputs)

    Returns
    -------
    (n_steps, n_states)
    """
    start, rise = inputs[:, 0], inputs[:, 1] - inputs[:, 0]
    out = np.zeros((index.size, hold.shape[1]), dtype=np.result_type(hold, inputs))
    if hold.shape[0] <= FEW_DISTINCT:
        for d in range(hold.shape[0]):
            here = index == d
            out[here] = start[here] @ hold[d].T + rise[here] @ ramp[d].T
        return out
    for first in range(0, index.size, GATHERED):
        part = slice(first, first + GATHERED)
        held, ramped = hold[index[part]], ramp[index[part]]
        out[part] = np.einsum("kij,kj->ki", held, start[part]) + np.einsum("kij,kj->ki", ramped, rise[part])
    return out
