"""Seeded spacecraft networks with an undeclared effect, simulated by SciPy: truth that our own solver has no part in."""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from benchmarks.case import Case, Truth, trace_of
from benchmarks.hidden_effects import HIDDEN
from benchmarks.network_world import NOTHING, SPACE_K, World
from benchmarks.outside_vocabulary import OUTSIDE
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record


def network_case(effect: str | None, seed: int, *, n_orbits: int = 12, dt_s: float = 60.0) -> Case:
    """Return a seeded case; the same seed is the same spacecraft whatever the effect."""
    rng = np.random.default_rng(seed)
    world = World(rng, n_orbits, dt_s)
    node = int(rng.integers(0, world.n))
    hidden = NOTHING if effect is None else (HIDDEN | OUTSIDE)[effect](world, node)
    begun = rng.bit_generator.state
    healthy = world.simulate()[:, : world.n]
    rng.bit_generator.state = begun
    states = world.simulate(hidden)
    truth = states[:, : world.n]
    read = truth.copy() if hidden.offset_K is None else truth + hidden.offset_K
    for at, state in hidden.reads.items():
        read[:, at] = states[:, state]
    noise = float(rng.uniform(0.05, 0.15))
    unsensed = int(rng.integers(0, world.n)) if rng.random() < 0.3 else None
    if hidden.where.get("sensor") == f"T{unsensed}":
        unsensed = None
    values = {"T_room": world.room_K, "mode": world.mode}
    capacity = world.capacity.copy()
    for i in range(world.n):
        capacity[i] *= np.exp(rng.normal(0, 0.3))
        if i != unsensed:
            values[f"T{i}"] = read[:, i] + rng.normal(0, noise, world.time_s.size)
    conductance = [g * np.exp(rng.normal(0, 0.4)) for g in world.conductance]
    values |= inputs(world)
    spec = declared(world, capacity.tolist(), conductance, () if unsensed is None else (unsensed,), f"case-{seed}")
    record = Record(world.time_s, values, None, f"case-{seed}")
    trace = trace_of(read - healthy, noise)
    truths = () if effect is None else (Truth(effect, hidden.where, hidden.parameters, hidden.onset_s, trace),)
    return Case(spec, record, truths, truth, noise)


def inputs(world: World) -> dict[str, np.ndarray]:
    """Return the declared power, by channel."""
    return {f"S{i}": q for i, q in world.sun.items()} | {f"P{i}": q for i, q in world.power.items()}


def declared(
    world: World, capacity: Sequence[float], conductance: Sequence[float], unread: Collection[int], name: str
) -> TwinSpec:
    """Return the specification of a network with such guesses of its capacities and conductances.

    Nodes of ``unread`` have no sensor.
    """
    channels: dict[str, Any] = {
        "T_room": {"kind": "temperature", "unit": "K"},
        "mode": {"kind": "auxiliary", "levels": True},
    }
    channels |= {f"T{i}": {"kind": "temperature", "unit": "K"} for i in range(world.n) if i not in unread}
    channels |= {channel: {"kind": "power", "unit": "W"} for channel in inputs(world)}
    return load_spec(
        {
            "twin": name,
            "boundaries": {"space": {"value_K": SPACE_K}, "room": {"channel": "T_room"}},
            "channels": channels,
            "nodes": [
                {"id": f"n{i}", "capacity_J_per_K": {"guess": c}} | ({} if i in unread else {"sensor": f"T{i}"})
                for i, c in enumerate(capacity)
            ],
            "conductors": [
                {"between": [f"n{a}", f"n{b}"], "conductance_W_per_K": {"guess": g}}
                for (a, b), g in zip(world.edges, conductance, strict=True)
            ],
            "radiators": [
                {"node": f"n{i}", "emissivity": 1.0, "area_m2": a, "sink": "space"} for i, a in world.radiators.items()
            ],
            "loads": [{"channel": channel, "node": f"n{channel[1:]}"} for channel in inputs(world)],
        }
    )
