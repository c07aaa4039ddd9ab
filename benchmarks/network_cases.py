"""Seeded spacecraft networks with an undeclared effect, simulated by SciPy: truth that our own solver has no part in."""

from typing import Any

import numpy as np

from benchmarks.case import Case, Truth, trace_of
from benchmarks.hidden_effects import HIDDEN
from benchmarks.network_world import NOTHING, SPACE_K, World
from benchmarks.outside_vocabulary import OUTSIDE
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
            values[f"T{i}"] = read[:, i] + rng.normal(0, noise, world.time_s.size)
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
    record = Record(world.time_s, values, None, f"case-{seed}")
    trace = trace_of(read - healthy, noise)
    truths = () if effect is None else (Truth(effect, hidden.where, hidden.parameters, hidden.onset_s, trace),)
    return Case(spec, record, truths, truth, noise)
