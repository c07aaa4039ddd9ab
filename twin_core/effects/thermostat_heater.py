"""An undeclared thermostat: a survival heater with hysteresis that nobody wrote into the declaration."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, ExtraNode, Layout
from twin_core.network.thermostat import Memory, ThermostatHeat
from twin_core.parameters.parameter import positive

ON_QUANTILES = (0.005, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7)
OFF_QUANTILES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 0.95)
"""Temperatures dwell at the lower threshold of a heater that keeps them from falling, so it is looked for more finely."""
LEAST_BAND_K = 0.3
RATE_QUANTILE = 0.8

STEP_LIMIT_K = 1.0
"""One step of a solver moves a threshold this far at most: its slope is felt at the switchings alone."""

DELAY_SHARE = 0.002
"""Time constant of the memory over the sampling interval."""


class ThermostatHeater(Effect):
    """q = Q, on below T_on, off above T_off."""

    name = "thermostat_heater"
    keys = ("node",)
    equation = "q = Q from T < T_on until T > T_off, else 0"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 7"
    sentence = "a thermostatically controlled heater on {node} was missing"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return power and both thresholds."""
        return (
            ParameterSpec("Q_W", "W", null=0.0, positive=True),
            ParameterSpec("T_on_K", "K", prior_std=10.0, step_limit=STEP_LIMIT_K),
            ParameterSpec("T_off_K", "K", prior_std=10.0, step_limit=STEP_LIMIT_K),
        )

    @property
    def _state(self) -> str:
        return f"{self.where['node']}.thermostat"

    def extra_nodes(self, layout: Layout) -> tuple[ExtraNode, ...]:
        """Return the memory as a state of unit capacity."""
        unit = positive(f"C:{self._state}", "J/K", 1.0, frozen=True)
        return (ExtraNode(self._state, unit, self.where["node"]),)

    def addition(self, layout: Layout) -> Addition:
        """Return heater and memory."""
        node, state = layout.node(self.where["node"]), layout.node(self._state)
        memory = Memory(*(float(self.settings[key]) for key in ("off_state_K", "on_state_K", "delay_s")))
        return Addition((ThermostatHeat(node, state, float(self.settings["rate_K_per_s"]), memory, self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node."""
        yield from ({"node": node} for node in layout.declared_nodes)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield pairs of thresholds among the quantiles of the visited temperatures."""
        temperature = survey.temperature_K(where["node"])
        lows, highs = np.quantile(temperature, ON_QUANTILES), np.quantile(temperature, OFF_QUANTILES)
        steps, moved = np.diff(survey.along.time_s), np.abs(np.diff(temperature))
        rate = float(np.quantile(moved[steps > 0] / steps[steps > 0], RATE_QUANTILE))
        delay = DELAY_SHARE * float(np.median(steps[steps > 0]))
        for low, high in product(lows.tolist(), highs.tolist()):
            if high - low > LEAST_BAND_K:
                settings = {"off_state_K": low, "on_state_K": high, "rate_K_per_s": rate, "delay_s": delay}
                yield cls(where, {"Q_W": 0.0, "T_on_K": low, "T_off_K": high}, settings)

    def unit_heats(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return the share of full power along the survey, from the crossings of the thresholds."""
        alone = replace(survey.layout, nodes=(*survey.layout.nodes, self._state))
        (term,) = self.addition(alone).terms
        values = np.array([1.0, self.values["T_on_K"], self.values["T_off_K"]])
        share = np.zeros(survey.along.time_s.size)
        for s in survey.segments():
            temperatures = survey.along.temperatures_K[s]
            start = np.full((temperatures.shape[0], 1), temperatures[0, survey.layout.node(self.where["node"])])
            along = replace(
                survey.along, time_s=survey.along.time_s[s], temperatures_K=np.hstack([temperatures, start])
            )
            share[s] = term.evaluate(along, values).heat_W[:, 0]
        return [[(survey.layout.node(self.where["node"]), share)]]
