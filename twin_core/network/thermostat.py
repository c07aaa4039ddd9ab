"""The heat of a thermostat: a relay with hysteresis, and the state that remembers it."""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.terms import Along, Entry, Heat, Relay
from twin_core.parameters.parameter import Parameter

LEAST_TRAVEL_K = 0.005
"""A node that moves less between two points counts as moving this far: its slope with a threshold is bounded."""

UNSETTLED = 0.02
"""A step after each switching, all but a hundredth is done, and that counts as done."""


@dataclass(frozen=True)
class Switching:
    """What a thermostat does along a temperature, (n_points,) each.

    Attributes
    ----------
    share
        Share of full power.
    by_memory, by_temperature
        Its slopes with the share that is remembered and with the temperature (1/K) at the same point.
    by_on, by_off
        Its slope with either threshold, in 1/K: a switching instant moves along the temperature.
    called
        On (1), off (-1), or none of them known (0) after the point.
    """

    share: FloatArray
    by_memory: FloatArray
    by_temperature: FloatArray
    by_on: FloatArray
    by_off: FloatArray
    called: IntArray


def switching(
    time_s: FloatArray,
    temperature_K: FloatArray,
    on_K: float,
    off_K: float,
    remembered: FloatArray,
    rate_K_per_s: float,
) -> Switching:
    """Return how a thermostat switches along a given temperature; a rollout switches in its own steps (``kernels``).

    A threshold is crossed at the instant that a straight line over the step tells; the step receives the heat from that
    instant on, held over all of it, so that the share is continuous in the instant.

    Parameters
    ----------
    time_s, temperature_K : (n_points,)
        Begin and end of every step, step after step.
    on_K, off_K
        Thresholds.
    remembered : (n_points,)
        Share of full power that the memory stands for; its first is in force until a threshold is passed.
    rate_K_per_s
        How fast the temperature came to the first point.
    """
    n_points = temperature_K.size
    beyond = np.where(temperature_K < on_K, 1, np.where(temperature_K > off_K, -1, 0))
    latest = np.maximum.accumulate(np.where(beyond != 0, np.arange(n_points), -1))
    called = np.where(latest >= 0, beyond[latest], 0)
    before = np.concatenate([[0], called[:-1]])
    old = np.where(before != 0, before == 1, remembered[0]).astype(np.float64)
    share = np.where(called != 0, called == 1, old)
    by_memory = np.where(called == 0, 1.0, 0.0)
    by_temperature, by_on, by_off = np.zeros(n_points), np.zeros(n_points), np.zeros(n_points)
    last = np.arange(1, n_points, 2)
    last = last[called[last] != before[last]]
    first = last - 1
    travel = temperature_K[last] - temperature_K[first]
    travel = np.copysign(np.maximum(np.abs(travel), LEAST_TRAVEL_K), travel)
    threshold = np.where(called[last] == 1, on_K, off_K)
    passed = (temperature_K[last] - threshold) / travel
    gap = share[last] - old[last]
    share[last] = share[first] = old[last] + gap * passed
    by_memory[first] = by_memory[last] = np.where(before[last] == 0, 1.0 - passed, 0.0)
    # Each point bears the part of the slope that comes through its own temperature; both count for half of the step.
    by_temperature[first], by_temperature[last] = 2.0 * gap * passed / travel, 2.0 * gap * (1.0 - passed) / travel
    for slope, which in ((by_on, 1), (by_off, -1)):
        slope[first] = slope[last] = np.where(called[last] == which, -gap / travel, 0.0)
    if n_points > 1 and called[0] != 0:  # how far beyond tells how long ago it was passed
        reach = max(rate_K_per_s * float(time_s[1] - time_s[0]), LEAST_TRAVEL_K)
        distance = on_K - temperature_K[0] if called[0] == 1 else temperature_K[0] - off_K
        passed_first, gap_first = min(float(distance) / reach, 1.0), float(called[0] == 1) - remembered[0]
        share[0] = remembered[0] + gap_first * passed_first
        by_memory[0] = 1.0 - passed_first
        if passed_first < 1.0:
            slope_first = gap_first / reach * (1.0 if called[0] == 1 else -1.0)
            by_temperature[0] = -slope_first
            by_on[0], by_off[0] = (slope_first, 0.0) if called[0] == 1 else (0.0, slope_first)
    return Switching(share, by_memory, by_temperature, by_on, by_off, called)


@dataclass(frozen=True)
class Memory:
    """The state of the network that remembers a relay wherever a record is cut, as a temperature.

    Attributes
    ----------
    off_K, on_K
        What stands for off and on. These are thresholds that a search started from: a memory that begins at its node's
        temperature says off where that has just fallen to the lower, on where it has risen to the upper.
    delay_s
        Time constant with which it follows the relay.
    """

    off_K: float
    on_K: float
    delay_s: float

    def share(self, state_K: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the share of full power that a state stands for, and its slope in 1/K."""
        slope = (1.0 + UNSETTLED) / (self.on_K - self.off_K)
        share = slope * (state_K - self.off_K) - 0.5 * UNSETTLED
        return np.clip(share, 0.0, 1.0), np.where((share > 0.0) & (share < 1.0), slope, 0.0)

    def rate_K_per_s(self, state_K: FloatArray, called: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return how fast it follows, and the slope of that in 1/s; the first point is what it remembers."""
        follows = (called != 0) & (np.arange(called.size) > 0)
        target = np.where(called == 1, self.on_K, self.off_K)
        return (
            np.where(follows, (target - state_K) / self.delay_s, 0.0),
            np.where(follows, -1.0 / self.delay_s, 0.0),
        )


@dataclass(frozen=True)
class ThermostatHeat:
    """q = Q, on below T_on, off above T_off; values are Q, T_on, T_off.

    Until a threshold is passed, the memory tells; from then on, the temperatures.
    """

    node: int
    state: int
    rate_K_per_s: float
    memory: Memory
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate heater and memory, which has unit capacity, so that its heat is its rate."""
        power, on_K, off_K = values
        state = along.temperatures_K[:, self.state]
        remembered, slope = self.memory.share(state)
        temperature = along.temperatures_K[:, self.node]
        relay = switching(along.time_s, temperature, on_K, off_K, remembered, self.rate_K_per_s)
        rate, decay = self.memory.rate_K_per_s(state, relay.called)
        by_node, by_state = power * relay.by_temperature, power * relay.by_memory * slope
        jacobian = np.stack([np.stack([by_node, by_state], -1), np.stack([np.zeros_like(decay), decay], -1)], axis=-2)
        return Heat(
            (self.node, self.state),
            np.stack([power * relay.share, rate], axis=1),
            jacobian,
            [
                Entry(0, self.node, relay.share),
                Entry(1, self.node, power * relay.by_on),
                Entry(2, self.node, power * relay.by_off),
            ],
            relay=Relay(
                self.node,
                self.state,
                power,
                on_K,
                off_K,
                self.memory.off_K,
                self.memory.on_K,
                self.rate_K_per_s,
            ),
        )
