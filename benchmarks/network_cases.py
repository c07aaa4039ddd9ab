"""Seeded spacecraft networks with an undeclared effect, simulated by SciPy: truth that our own solver has no part in."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from twin_core.network.spec import TwinSpec, load_spec
from twin_core.telemetry import Record

SIGMA = 5.670374419e-8
SPACE_K = 2.7


@dataclass(frozen=True)
class Case:
    """One case: what the operator declares and sees, and what is really there (None on a healthy spacecraft)."""

    spec: TwinSpec
    record: Record
    effect: str | None
    where: dict[str, Any]
    truth_K: np.ndarray


class _World:
    """A random spacecraft: capacities, a connected graph, radiators, sun and payload heat."""

    def __init__(self, rng: np.random.Generator, n_orbits: int, dt_s: float) -> None:
        self.rng = rng
        self.n = int(rng.integers(4, 8))
        self.period_s = float(rng.uniform(5400, 6000))
        self.time_s = np.arange(0.0, n_orbits * self.period_s, dt_s)
        self.capacity = np.exp(rng.uniform(np.log(2e3), np.log(3e4), self.n))
        self.edges = [(int(rng.integers(0, i)), i) for i in range(1, self.n)]
        for _ in range(int(rng.integers(0, 3))):
            a, b = sorted(rng.choice(self.n, 2, replace=False).tolist())
            if (a, b) not in self.edges:
                self.edges.append((a, b))
        self.conductance = np.exp(rng.uniform(np.log(0.5), np.log(6.0), len(self.edges)))
        self.radiators = {int(i): float(rng.uniform(0.1, 0.5)) for i in rng.choice(self.n, 2, replace=False)}
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
        nodes = self.rng.choice(self.n, min(3, self.n), replace=False)
        self.power = {}
        for node in nodes:
            switches = np.repeat(self.rng.integers(0, 4, self.time_s.size // 31 + 1), 31)[: self.time_s.size]
            self.power[int(node)] = 0.25 * load * self.rng.uniform(0.4, 1.0) * switches / 1.5 / len(nodes) * 1.6

    def simulate(self, hidden: Any, extra: int = 0) -> np.ndarray:
        """Return the true temperatures, (n_times, n + extra)."""
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

        def rates(t: float, state: np.ndarray, k: int) -> np.ndarray:
            x = state[: self.n]
            q = heat[k] + laplacian @ x + SIGMA * area * (SPACE_K**4 - x**4)
            more, rest = hidden(t, k, state)
            return np.concatenate([(q + more) / self.capacity, rest])

        state = np.concatenate([self.rng.uniform(280, 296, self.n), np.full(extra, 288.0)])
        if extra:
            state[self.n :] = state[int(self.rng.integers(0, self.n))]
        states = [state]
        for k in range(self.time_s.size - 1):
            span = (self.time_s[k], self.time_s[k + 1])
            out = solve_ivp(rates, span, state, args=(k,), method="RK45", rtol=1e-7, atol=1e-6)
            state = out.y[:, -1]
            states.append(state)
        return np.array(states)


def _hidden(world: _World, effect: str | None) -> tuple[Any, dict[str, Any], int]:
    """Return the hidden heat, its place, and how many states it adds."""
    rng, n = world.rng, world.n
    node = int(rng.integers(0, n))
    load = float(np.mean([q.mean() for q in (*world.sun.values(), *world.power.values())]))
    nothing = np.zeros(0)
    name = f"n{node}"

    def into(q: Any) -> Any:
        def heat(t: float, k: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            more = np.zeros(n)
            more[node] = q(t, k, x[node])
            return more, nothing

        return heat

    if effect is None:
        return into(lambda t, k, x: 0.0), {}, 0
    if effect == "radiation_to_sink":
        area = float(rng.uniform(0.05, 0.15))
        return into(lambda t, k, x: SIGMA * area * (SPACE_K**4 - x**4)), {"node": name, "sink": "space"}, 0
    if effect == "leak_to_boundary":
        g = float(rng.uniform(0.3, 1.5))
        return into(lambda t, k, x: g * (world.room_K[k] - x)), {"node": name, "boundary": "room"}, 0
    if effect == "constant_heat_load":
        q0 = load * float(rng.uniform(0.2, 0.5)) * rng.choice([-1.0, 1.0])
        return into(lambda t, k, x: q0), {"node": name}, 0
    if effect == "channel_heat_load":
        table = load * rng.uniform(0.2, 0.8, 3) * np.array([0.0, 1.0, -0.6])
        return into(lambda t, k, x: table[int(world.mode[k])]), {"node": name, "channel": "mode"}, 0
    if effect == "proportional_heater":
        gain, limit = float(rng.uniform(2.0, 6.0)), load * float(rng.uniform(0.4, 0.9))
        base = world.simulate(lambda t, k, x: (np.zeros(n), nothing))[:, node]
        set_point = float(np.quantile(base, 0.6))
        return into(lambda t, k, x: min(limit, gain * max(set_point - x, 0.0))), {"node": name}, 0
    if effect == "input_gain":
        channel = int(rng.choice(list(world.power)))
        g = float(rng.choice([rng.uniform(0.5, 0.8), rng.uniform(1.2, 1.5)]))

        def gained(t: float, k: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            more = np.zeros(n)
            more[channel] = (g - 1.0) * world.power[channel][k]
            return more, nothing

        return gained, {"channel": f"P{channel}"}, 0
    if effect == "missing_conductor":
        pairs = [(a, b) for a in range(n) for b in range(a + 1, n) if (a, b) not in world.edges]
        a, b = pairs[int(rng.integers(0, len(pairs)))]
        g = float(rng.uniform(0.5, 2.0))

        def strap(t: float, k: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            more = np.zeros(n)
            more[a], more[b] = g * (x[b] - x[a]), g * (x[a] - x[b])
            return more, nothing

        return strap, {"nodes": [f"n{a}", f"n{b}"]}, 0
    if effect == "hidden_mass":
        mass = float(world.capacity[node] * rng.uniform(0.5, 2.0))
        g = mass / float(rng.uniform(0.2, 1.0) * world.period_s)

        def coupled(t: float, k: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            more = np.zeros(n)
            more[node] = g * (x[n] - x[node])
            return more, np.array([g * (x[node] - x[n]) / mass])

        return coupled, {"node": name}, 1
    raise ValueError(effect)


def network_case(effect: str | None, seed: int, *, n_orbits: int = 12, dt_s: float = 60.0) -> Case:
    """Return a seeded case; the same seed is the same spacecraft whatever the effect."""
    rng = np.random.default_rng(seed)
    world = _World(rng, n_orbits, dt_s)
    hidden, where, extra = _hidden(world, effect)
    truth = world.simulate(hidden, extra)[:, : world.n]
    noise = float(rng.uniform(0.05, 0.15))
    unsensed = int(rng.integers(0, world.n)) if rng.random() < 0.3 else None
    channels: dict[str, Any] = {
        "T_room": {"kind": "temperature", "unit": "K"},
        "mode": {"kind": "auxiliary", "levels": True},
    }
    values = {"T_room": world.room_K, "mode": world.mode}
    nodes, loads = [], []
    for i in range(world.n):
        row: dict[str, Any] = {
            "id": f"n{i}",
            "capacity_J_per_K": {"guess": world.capacity[i] * np.exp(rng.normal(0, 0.3))},
        }
        if i != unsensed:
            channels[f"T{i}"] = {"kind": "temperature", "unit": "K"}
            values[f"T{i}"] = truth[:, i] + rng.normal(0, noise, world.time_s.size)
            row["sensor"] = f"T{i}"
        nodes.append(row)
    for prefix, series in (("S", world.sun), ("P", world.power)):
        for node, q in series.items():
            channels[f"{prefix}{node}"] = {"kind": "power", "unit": "W"}
            values[f"{prefix}{node}"] = q
            loads.append({"channel": f"{prefix}{node}", "node": f"n{node}"})
    spec = load_spec(
        {
            "twin": f"case-{seed}",
            "boundaries": {"space": {"value_K": SPACE_K}, "room": {"channel": "T_room"}},
            "channels": channels,
            "nodes": nodes,
            "conductors": [
                {"between": [f"n{a}", f"n{b}"], "conductance_W_per_K": {"guess": g * np.exp(rng.normal(0, 0.4))}}
                for (a, b), g in zip(world.edges, world.conductance, strict=True)
            ],
            "radiators": [
                {"node": f"n{i}", "emissivity": 1.0, "area_m2": a, "sink": "space"} for i, a in world.radiators.items()
            ],
            "loads": loads,
        }
    )
    return Case(spec, Record(world.time_s, values, None, f"case-{seed}"), effect, where, truth)
