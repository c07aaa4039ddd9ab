"""Rollouts that leave what an effect was learned from: they say so, and their band grows."""

from collections.abc import Sequence

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.effects.base import Beyond, Effect
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.model import Network
from twin_core.network.surroundings import surround
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.response import heat_response
from twin_core.simulate.rollout import Rollout
from twin_core.simulate.stages import balance_along


def extrapolations(
    network: Network, effects: Sequence[Effect], forcing: Forcing, path: Rollout
) -> list[tuple[Effect, Beyond]]:
    """Return the effects that a rollout uses outside what they were learned from, and where.

    Parameters
    ----------
    network, forcing, path
        A rollout; nothing is told of one that has not converged.
    effects
        Those of the network, at its values.
    """
    if not path.converged:
        return []
    n_steps, n_nodes = forcing.n_steps, len(network.nodes)
    boundaries = fill_boundaries(network, network.parameters.values, forcing.boundaries_flat_K(0, n_steps))
    points = forcing.along(path.stages_K.reshape(-1, n_nodes), boundaries, 0, n_steps)
    along = surround(network, network.parameters.values, points).along
    found = [(effect, effect.beyond(network.layout, along)) for effect in effects]
    return [(effect, beyond) for effect, beyond in found if beyond is not None]


def extrapolated_variance_K2(
    network: Network, beyond: Sequence[Beyond], forcing: Forcing, path: Rollout, observed: IntArray
) -> FloatArray:
    """Return the variance that heats of unknown size add to the observed states, (n_samples, n_observed).

    What a curve gets wrong it gets wrong all along: the error of each effect is one number times its standard deviation.
    """
    if not beyond:
        return np.zeros((forcing.sample_step.size, observed.size))
    balance = balance_along(network, network.parameters.values, forcing, path.stages_K, 0, forcing.n_steps)
    heats = [(column, one.node, one.std_W) for column, one in enumerate(beyond)]
    response = heat_response(balance, forcing, heats, len(beyond), observed)
    return np.asarray((response**2).sum(axis=-1))


def in_words(found: Sequence[tuple[Effect, Beyond]]) -> tuple[str, ...]:
    """Return one sentence per effect that was used outside what it was learned from."""
    return tuple(
        f"{effect.label}: learned at {beyond.visited}; {beyond.outside.mean():.0%} of the prediction lies outside, where "
        "its heat is held and the band is widened"
        for effect, beyond in found
    )
