"""The heat that findings supply, and the nodes at which they do."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.discover.judge import Search
from twin_core.effects.base import touched_nodes
from twin_core.effects.heat import effect_heat_W
from twin_core.network.dynamics import fill_boundaries

MAX_NODES = 4
"""Nodes of interest at most."""


def nodes_of_interest(search: Search) -> list[str]:
    """Return the nodes that the findings touch, else the two with most undeclared heat for their size."""
    nodes: list[str] = []
    for finding in search.findings:
        for effect in finding.effects:
            nodes += touched_nodes(effect, search.base.fit.network.layout)
    if not nodes:
        declared = search.base.fit.problem.network.nodes
        nodes = [declared[i] for i in np.argsort(-search.base.fit.undeclared.std_W)[:2]]
    return list(dict.fromkeys(nodes))[:MAX_NODES]


def effect_heat(search: Search, states_K: FloatArray, first_step: int) -> FloatArray | None:
    """Return the heat of all findings into every declared node at the ends of the last segment's steps.

    Parameters
    ----------
    search
        Its trial carries the findings.
    states_K : (n_steps, n_nodes)
        Temperatures of the declared nodes at the ends of the steps; nodes that an effect adds follow their trajectory.
    first_step
        Of the segment, to which the first row belongs.

    Returns
    -------
    (n_steps, n_nodes), or None
        In W, positive into the node; NaN for nodes into which no finding sends heat. None without findings.
    """
    if not search.findings:
        return None
    network = search.trial.calibration().network
    forcing = search.trial.fit.problem.segments[-1].forcing
    last = first_step + states_K.shape[0]
    stages = search.trial.calibration().optimum.fit.trajectories[-1].stages_K[first_step:last].copy()
    declared = search.base.fit.problem.n_nodes
    stages[:, :, :declared] = states_K[:, None, :]
    boundaries = fill_boundaries(network, network.parameters.values, forcing.boundaries_flat_K(first_step, last))
    along = forcing.along(stages.reshape(-1, stages.shape[2]), boundaries, first_step, last)
    total = np.sum([effect_heat_W(effect, network, along) for effect in search.trial.effects], axis=0)
    total[:, ~total.any(axis=0)] = np.nan
    return total[1::2, :declared]
