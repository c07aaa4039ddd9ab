"""A sink that follows its channel late: walls behind the air whose temperature is read, a shroud behind its controller."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.boundaries import boundary_places, changed_boundary, heat_of_change
from twin_core.effects.hidden_mass import first_order_lag
from twin_core.effects.sensor_lag import SCALED_UP_TO
from twin_core.network.model import Addition, ExtraNode, Layout
from twin_core.network.terms import Along, Entry, Heat, Sink
from twin_core.parameters.parameter import Parameter, positive

N_TIME_CONSTANTS = 8


@dataclass(frozen=True)
class LaggedSink:
    """T -> the temperature of a state."""

    boundary: int
    state: int
    parameters: tuple[Parameter, ...] = ()
    borrows: tuple[str, ...] = ()
    rank: int = 0

    def evaluate(self, given_K: FloatArray, along: Along, values: FloatArray) -> Sink:
        """Evaluate the sink: nothing of the channel itself is left."""
        lagged = along.temperatures_K[:, self.state]
        return Sink(lagged, np.zeros(given_K.size), d_states=[(self.state, np.ones(given_K.size))])


@dataclass(frozen=True)
class Following:
    """dr/dt = (T_s - r) / tau for a state r of unit capacity; T_s is the channel as it is declared."""

    boundary: int
    state: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the rate."""
        difference, rate = along.declared_K[:, self.boundary] - along.temperatures_K[:, self.state], 1.0 / values[0]
        entry = Entry(0, self.state, -(rate**2) * difference)
        return Heat((self.state,), (rate * difference)[:, None], np.full((1, 1, 1), -rate), [entry])


class BoundaryLag(Effect):
    """tau dr/dt = T_s - r: the sink is r.

    r is a state of the network, so that a filter, a forecast or a record that goes on knows what came before; in a record of
    its own it starts at the channel's first value.
    """

    name = "boundary_lag"
    keys = ("boundary",)
    equation = "tau dr/dt = T_s - r, sink = r"
    reference = "Incropera et al., Fundamentals of Heat and Mass Transfer, 7th ed., ch. 5 (lumped capacitance)"
    sentence = "the temperature of {boundary} lags behind its channel"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the time constant; a lag of zero is none, one far longer than the record is a constant sink."""
        return (ParameterSpec("tau_s", "s", null=0.0, positive=True, prior_std=3.0, open_ended=True),)

    @property
    def _state(self) -> str:
        return f"{self.where['boundary']}.lag"

    def extra_nodes(self, layout: Layout) -> tuple[ExtraNode, ...]:
        """Return the lagging temperature as a state of unit capacity that starts where the channel does."""
        boundary = self.where["boundary"]
        changed_boundary(self, layout, constant=False)
        near = next((node for node, name in layout.surfaces if name == boundary), layout.nodes[0])
        unit = positive(f"{self.label}.unit", "J/K", 1.0, frozen=True)
        return (ExtraNode(self._state, unit, near, follows=boundary),)

    def addition(self, layout: Layout) -> Addition:
        """Return the lag and what it makes of the boundary."""
        boundary, state = changed_boundary(self, layout, constant=False), layout.node(self._state)
        return Addition((Following(boundary, state, self.parameters()),), boundaries=(LaggedSink(boundary, state),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every boundary that a channel tells."""
        yield from boundary_places(layout, constant=False)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield time constants from two samples to the length of the record."""
        time_s = survey.along.time_s
        steps = np.diff(time_s)
        shortest = 2.0 * float(np.median(steps[steps > 0]))
        longest = max(float(time_s[s][-1] - time_s[s][0]) for s in survey.segments())
        for tau in np.geomspace(shortest, max(longest, 2.0 * shortest), N_TIME_CONSTANTS):
            yield cls(where, {"tau_s": 0.0}, {"start_s": float(tau)})

    @property
    def linear_up_to(self) -> float:
        """The time constant to which the response at the assumed one can be scaled: nearly that of the next start."""
        return SCALED_UP_TO * float(self.settings["start_s"])

    def unit_heats(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return the heat per second of lag, at the lag that this start assumes."""
        given, tau = survey.declared_boundary_K(self.where["boundary"]), self.settings["start_s"]
        change = np.empty_like(given)
        for s in survey.segments():
            change[s] = (first_order_lag(survey.along.time_s[s], given[s], tau) - given[s]) / tau
        return [heat_of_change(survey, self.where["boundary"], change)]
