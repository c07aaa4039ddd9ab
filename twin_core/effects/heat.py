"""The heat that one effect of a model brings into its nodes."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect
from twin_core.network.model import Network
from twin_core.network.surroundings import boundary_heats_W
from twin_core.network.terms import Along


def effect_heat_W(effect: Effect, network: Network, along: Along) -> FloatArray:
    """Return the heat of an effect of a network at the network's own values, (n_points, n_nodes).

    Terms see the boundaries as they are declared; what a change of a boundary brings, through whatever reads it, is its own.
    So the heats of all effects and of the declared network add up to the net heat.

    Parameters
    ----------
    effect
        One of those that the network was built with.
    network
        At its values.
    along
        The points, unknown constants filled.
    """
    values, addition = network.parameters.values, effect.addition(network.layout)
    total = np.zeros((along.time_s.size, len(network.nodes)))
    for term in addition.terms:
        part = term.evaluate(along, values[network.term_index(term)])
        total[:, list(part.nodes)] += part.heat_W
    if addition.boundaries:
        total += sum(heat for term, heat in boundary_heats_W(network, values, along) if term in addition.boundaries)
    return total
