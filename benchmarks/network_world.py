"""A random spacecraft as a network, integrated by SciPy: truth that our own solver has no part in."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

SIGMA = 5.670374419e-8
SPACE_K = 2.7

HOTTEST_K = 1000.0
"""No spacecraft: a heat that feeds on its own temperature has run away, up or below 0 K, and no integrator would end."""

Heat = Callable[[float, int, np.ndarray], np.ndarray]
"""(time in s, sample, states) -> W into every node."""


@dataclass(frozen=True)
class Hidden:
    """What the declared network lacks.

    Attributes
    ----------
    where
        Its place, by the report's keys.
    heat
        Heat beyond the declared one.
    capacity : states -> (n_nodes,)
        Capacity beyond the declared one, in J/K.
    rates : states -> (n_extra,)
        Rates of the states that it adds, in K/s; they follow those of the nodes.
    n_extra
        How many states it adds.
    switch
        A relay: ``crossing(states)`` falls through zero where ``flip()`` is due.
    offset_K : (n_times, n_nodes)
        What the sensors read beyond the truth.
    reads : node -> state
        Which state its sensor reads instead of it.
    onset_s
        When it sets in; None where it is there from the start.
    parameters
        Its size, by the report's names.
    """

    where: dict[str, Any]
    heat: Heat | None = None
    capacity: Callable[[np.ndarray], np.ndarray] | None = None
    rates: Callable[[np.ndarray], np.ndarray] | None = None
    n_extra: int = 0
    switch: "Switch | None" = None
    offset_K: np.ndarray | None = None
    reads: dict[int, int] = field(default_factory=dict)
    onset_s: float | None = None
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Switch:
    """A relay whose state changes where a function of the states falls through zero."""

    crossing: Callable[[np.ndarray], float]
    flip: Callable[[], None]


NOTHING = Hidden({})


class World:
    """A random spacecraft: capacities, a connected graph, radiators, sun and payload heat."""

    def __init__(self, rng: np.random.Generator, n_orbits: int, dt_s: float, n_nodes: int | None = None) -> None:
        self.rng = rng
        self.n = int(rng.integers(4, 8)) if n_nodes is None else n_nodes
        self.period_s = float(rng.uniform(5400, 6000))
        self.time_s = np.arange(0.0, n_orbits * self.period_s, dt_s)
        self.capacity = np.exp(rng.uniform(np.log(2e3), np.log(3e4), self.n))
        self.edges = [(int(rng.integers(0, i)), i) for i in range(1, self.n)]
        for _ in range(int(rng.integers(0, max(3, self.n // 3)))):
            a, b = sorted(rng.choice(self.n, 2, replace=False).tolist())
            if (a, b) not in self.edges:
                self.edges.append((a, b))
        self.conductance = np.exp(rng.uniform(np.log(0.5), np.log(6.0), len(self.edges)))
        n_radiators = max(2, self.n // 5)
        self.radiators = {int(i): float(rng.uniform(0.1, 0.5)) for i in rng.choice(self.n, n_radiators, replace=False)}
        self.radiators.setdefault(int(np.argmax(self.capacity)), 0.2)
        self._inputs()
        self.room_K = 288.0 + 4.0 * np.sin(2 * np.pi * self.time_s / (7.3 * self.period_s))
        self.mode = np.repeat(rng.choice([0.0, 1.0, 2.0], self.time_s.size // 47 + 1), 47)[: self.time_s.size]

    def _inputs(self) -> None:
        phase = 2 * np.pi * self.time_s / self.period_s
        lit = np.sin(phase) > -0.35
        load = sum(area * SIGMA * 288.0**4 for area in self.radiators.values())
        share = self.rng.dirichlet(np.ones(len(self.radiators)) * 3)
        self.sun = {
            node: 1.2 * load * s * np.maximum(np.sin(phase + self.rng.uniform(-0.5, 0.5)), 0) * lit
            for node, s in zip(self.radiators, share, strict=True)
        }
        nodes = self.rng.choice(self.n, max(min(3, self.n), self.n // 5), replace=False)
        self.power = {}
        for node in nodes:
            switches = np.repeat(self.rng.integers(0, 4, self.time_s.size // 31 + 1), 31)[: self.time_s.size]
            self.power[int(node)] = 0.25 * load * self.rng.uniform(0.4, 1.0) * switches / 1.5 / len(nodes) * 1.6

    @property
    def mean_load_W(self) -> float:
        """Mean of the declared heat inputs, each over the record."""
        return float(np.mean([q.mean() for q in (*self.sun.values(), *self.power.values())]))

    def _declared_rates(self) -> Callable[[int, np.ndarray], np.ndarray]:
        """Return the declared heat into the nodes as a function of the sample and their temperatures."""
        laplacian = np.zeros((self.n, self.n))
        for (a, b), g in zip(self.edges, self.conductance, strict=True):
            laplacian[a, a] -= g
            laplacian[b, b] -= g
            laplacian[a, b] += g
            laplacian[b, a] += g
        area = np.array([self.radiators.get(i, 0.0) for i in range(self.n)])
        heat = np.zeros((self.time_s.size, self.n))
        for node, q in (*self.sun.items(), *self.power.items()):
            heat[:, node] += q
        return lambda k, x: heat[k] + laplacian @ x + SIGMA * area * (SPACE_K**4 - x**4)

    def simulate(self, hidden: Hidden = NOTHING) -> np.ndarray:
        """Return the true temperatures, (n_times, n + extra); ArithmeticError where what is hidden runs away with them."""
        declared = self._declared_rates()

        def rates(t: float, state: np.ndarray, k: int) -> np.ndarray:
            q = declared(k, state[: self.n])
            if hidden.heat is not None:
                q = q + hidden.heat(t, k, state)
            capacity = self.capacity if hidden.capacity is None else self.capacity + hidden.capacity(state)
            rest = np.zeros(0) if hidden.rates is None else hidden.rates(state)
            return np.concatenate([q / capacity, rest])

        state = np.concatenate([self.rng.uniform(280, 296, self.n), np.full(hidden.n_extra, 288.0)])
        if hidden.n_extra:
            state[self.n :] = state[int(self.rng.integers(0, self.n))]
        states = [state]
        for k in range(self.time_s.size - 1):
            state = _advance(rates, self.time_s[k], self.time_s[k + 1], state, k, hidden.switch)
            if not np.all((state[: self.n] > 0.0) & (state[: self.n] < HOTTEST_K)):
                raise ArithmeticError(
                    f"a node leaves 0 to {HOTTEST_K:g} K by {self.time_s[k + 1]:g} s: what is hidden runs away"
                )
            states.append(state)
        return np.array(states)


def _advance(rates: Any, start: float, stop: float, state: np.ndarray, k: int, switch: Switch | None) -> np.ndarray:
    """Return the state at the next sample; a relay's changes are met to the instant."""

    def crossing(t: float, x: np.ndarray, k: int) -> float:
        assert switch is not None
        return switch.crossing(x)

    crossing.terminal, crossing.direction = True, -1.0  # type: ignore[attr-defined]
    events = None if switch is None else crossing
    if switch is not None and switch.crossing(state) <= 0.0:
        switch.flip()
    while start < stop:
        out = solve_ivp(rates, (start, stop), state, args=(k,), method="RK45", rtol=1e-7, atol=1e-6, events=events)
        start, state = float(out.t[-1]), out.y[:, -1]
        if switch is not None and out.status == 1:
            switch.flip()
    return state
