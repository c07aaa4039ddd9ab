"""A mass that nobody declared, behind a conductance: a slow housing, a tank of propellant, a sensor's own mount."""

from collections.abc import Iterable
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.missing_conductor import PairConductor
from twin_core.network.model import Addition, ExtraNode, Layout

N_TIME_CONSTANTS = 8


class HiddenMass(Effect):
    """An unseen C_h behind G_h: C_h dT_h/dt = G_h (T - T_h), and the opposite heat into the node."""

    name = "hidden_mass"
    keys = ("node",)
    equation = "C_h dT_h/dt = G_h (T - T_h), q = G_h (T_h - T)"
    reference = "Paper A, section 2: nodes beyond the sensor locations (n > p)"
    sentence = "a thermal mass behind {node} was missing"
    adds_mass = True

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return capacity and conductance; without conductance the mass is not there."""
        return (
            ParameterSpec("C_J_per_K", "J/K", positive=True, prior_std=3.0),
            ParameterSpec("G_W_per_K", "W/K", null=0.0, positive=True),
        )

    @property
    def _state(self) -> str:
        return f"{self.where['node']}.hidden_mass"

    def extra_nodes(self, layout: Layout) -> tuple[ExtraNode, ...]:
        """Return the mass as a state that starts at its node's temperature."""
        return (ExtraNode(self._state, self.parameters()[0], self.where["node"]),)

    def addition(self, layout: Layout) -> Addition:
        """Return the coupling between the node and the mass."""
        node, mass = layout.node(self.where["node"]), layout.node(self._state)
        return Addition((PairConductor(node, mass, self.parameters()[1:]),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node."""
        yield from ({"node": node} for node in layout.declared_nodes)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield time constants C_h / G_h from a few samples to the length of the record."""
        time_s = survey.along.time_s
        steps = np.diff(time_s)
        shortest = float(np.median(steps[steps > 0]))
        longest = max(float(time_s[s][-1] - time_s[s][0]) for s in survey.segments())
        for tau in np.geomspace(shortest, longest, N_TIME_CONSTANTS):
            yield cls(where, {"C_J_per_K": 1.0, "G_W_per_K": 0.0}, {"tau_s": float(tau)})

    def unit_heats(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return the heat per unit conductance: the mass follows its node as a first-order lag of ``tau_s``."""
        temperature = survey.temperature_K(self.where["node"])
        lagged = np.empty_like(temperature)
        for s in survey.segments():
            lagged[s] = first_order_lag(survey.along.time_s[s], temperature[s], self.settings["tau_s"])
        return [[(survey.layout.node(self.where["node"]), lagged - temperature)]]

    def with_amplitudes(self, amounts: FloatArray) -> "HiddenMass | None":
        """Return the mass with the capacity that its time constant asks for."""
        moved = super().with_amplitudes(amounts)
        if moved is None:
            return None
        return moved.with_values({"C_J_per_K": moved.values["G_W_per_K"] * self.settings["tau_s"]})


def first_order_lag(time_s: FloatArray, series: FloatArray, tau_s: float) -> FloatArray:
    """Return the response of tau dy/dt = x - y, y(0) = x(0), to a series that is linear between its points.

    Parameters
    ----------
    time_s, series : (n_points,)
    tau_s
        Time constant, positive.

    Returns
    -------
    (n_points,)
        Exact at the points. A loop over points: the recursion is inherently serial and cheap.
    """
    step = np.diff(time_s)
    decay = np.exp(-step / tau_s)
    ratio = np.where(step > 0, tau_s / np.maximum(step, 1e-300) * (1.0 - decay), 1.0)
    lagged = [float(series[0])]
    before, after = series[:-1].tolist(), series[1:].tolist()
    for keep, share, x0, x1 in zip(decay.tolist(), ratio.tolist(), before, after, strict=True):
        lagged.append(keep * lagged[-1] + (share - keep) * x0 + (1.0 - share) * x1)
    return np.array(lagged)
