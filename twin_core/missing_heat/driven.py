"""The heat of a coupling that was found, over what drives it: the difference of temperatures, or of what they radiate.

Points are component plus residual (Larsen and McCleary, "The use of partial residual plots in regression analysis", 1972):
the effect's own heat and whatever heat the corrected model still lacks at that node. Where the effect is the law, they lie
about its line; where they bend away from it, it is not. The heat that the declared model lacks would not do: its parameters
have taken up a part of the truth.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.calibrate.containment import NO_DEADLINE, TimeIsUpError, check_time, limited
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.discover.judge import Search
from twin_core.effects.base import Effect
from twin_core.effects.heat import effect_heat_W
from twin_core.errors import TwinError
from twin_core.missing_heat.smoothed import not_in_report, smoothed_force
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.model import Layout
from twin_core.network.terms import Along

AXES = {"difference": ("K", "{b} minus {a}"), "radiation": ("W/m²", "σ (T⁴ of {b} − T⁴ of {a})")}
"""Unit and words of the axis of each driver."""


def driven_heat(search: Search, *, deadline: float = NO_DEADLINE) -> tuple[list[Json], list[str]]:
    """Return, for each coupling among the findings, its heat over what drives it, and notices of what could not be told.

    Parameters
    ----------
    search
        A finished search; its trial carries the findings.
    deadline
        On the clock of ``time.monotonic``.

    Returns
    -------
    list of dict
        ``node`` into which the heat flows, ``other`` end, ``unit`` and ``axis`` of ``x``; ``heat_W`` with ``std_W`` (points, one
        per step of the last training segment or its end); ``effect_W``, the effect's own heat at the same points.
    """
    effects = [effect for effect in search.trial.effects if effect.driven_by]
    if not effects:
        return [], []
    nodes = list(dict.fromkeys(_ends(effect)[0] for effect in effects))
    fit = search.trial.fit
    try:
        with limited(deadline):
            check_time()
            force, _, _, _, view = smoothed_force(fit, nodes)
    except (TwinError, ArithmeticError, np.linalg.LinAlgError, TimeIsUpError) as error:
        return [], [not_in_report("the heat of the couplings that were found", error)]
    network = fit.network
    states = force.temperature_K[1:]
    n_steps = states.shape[0]
    boundaries = fill_boundaries(network, network.parameters.values, view.forcing.boundaries_flat_K(0, n_steps))
    both_ends = view.forcing.along(np.repeat(states, 2, axis=0), boundaries, 0, n_steps)
    found = []
    for effect in effects:
        at, other = _ends(effect)
        k = force.nodes.index(network.nodes.index(at))
        own = effect_heat_W(effect, network, both_ends)[1::2, network.nodes.index(at)]
        unit, axis = AXES[effect.driven_by]
        heat, std = own + force.mean_W[1:, k], force.std_W[1:, k]
        if not (np.isfinite(heat).all() and np.isfinite(std).all()):
            continue
        found.append(
            {
                "node": at,
                "other": other,
                "unit": unit,
                "axis": axis.format(a=at, b=other),
                "x": _driver(effect, network.layout, both_ends)[1::2],
                "heat_W": heat,
                "std_W": std,
                "effect_W": own,
            }
        )
    return found, []


def _ends(effect: Effect) -> tuple[str, str]:
    """Return the node into which the heat of a coupling flows, and its other end."""
    where: Any = effect.where
    if "nodes" in where:
        first, second = where["nodes"]
        return str(first), str(second)
    return str(where["node"]), str(where.get("sink") or where.get("boundary"))


def _driver(effect: Effect, layout: Layout, along: Along) -> FloatArray:
    """Return what drives the heat of a coupling into its first end, (n_points,): in K, or in W/m²."""
    here, there = (_temperature_K(name, layout, along) for name in _ends(effect))
    if effect.driven_by == "radiation":
        return STEFAN_BOLTZMANN_W_PER_M2_K4 * (there**4 - here**4)
    return there - here


def _temperature_K(name: str, layout: Layout, along: Along) -> FloatArray:
    if name in layout.boundaries:
        return along.boundaries_K[:, layout.boundary(name)]
    return along.temperatures_K[:, layout.node(name)]


def thinned(items: Sequence[Json], keep: int) -> list[Json]:
    """Return the items with at most so many of their points, as lists."""
    rows = []
    for item in items:
        at = np.unique(np.linspace(0, item["x"].size - 1, min(item["x"].size, keep)).round().astype(int))
        rows.append(
            {key: value[at].tolist() if isinstance(value, np.ndarray) else value for key, value in item.items()}
        )
    return rows
