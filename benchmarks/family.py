"""Fifty siblings of one design with two orbits each: how well their parameters are known alone, and as a family.

The simulator is a plain Euler scheme of its own. ``python -m benchmarks.family`` writes ``benchmarks/tables/family.md``.
"""

import argparse
import time
from typing import Any

import numpy as np

from benchmarks.markdown import markdown_table, save_table
from twin_core.calibrate import calibrate
from twin_core.family import pool
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

SIGMA = 5.670374419e-8
ORBIT_S, SAMPLING_S, EULER_S = 5700.0, 60.0, 2.0
TRUTH = {"C:px": 9.0e3, "C:mid": 2.2e4, "C:tank": 1.4e4, "G:px|mid": 2.5, "G:mid|tank": 1.2}
"""Of the design; capacities in J/K, conductances in W/K."""
SPEC: dict[str, Any] = {
    "twin": "sibling",
    "boundaries": {"space": {"value_K": 2.7}},
    "channels": {
        "T_px": {"kind": "temperature", "unit": "K"},
        "T_mid": {"kind": "temperature", "unit": "K"},
        "T_tank": {"kind": "temperature", "unit": "K"},
        "Q": {"kind": "power", "unit": "W"},
        "H": {"kind": "power", "unit": "W"},
    },
    "nodes": [
        {"id": "px", "sensor": "T_px", "capacity_J_per_K": {"guess": 1.2e4}},
        {"id": "mid", "sensor": "T_mid", "capacity_J_per_K": {"guess": 1.6e4}},
        {"id": "tank", "sensor": "T_tank", "capacity_J_per_K": {"guess": 2.0e4}},
    ],
    "conductors": [
        {"between": ["px", "mid"], "conductance_W_per_K": {"guess": 1.8}},
        {"between": ["mid", "tank"], "conductance_W_per_K": {"guess": 2.0}},
    ],
    "radiators": [{"node": "px", "emissivity": 0.8, "area_m2": 0.35, "sink": "space"}],
    "loads": [{"channel": "Q", "node": "px"}, {"channel": "H", "node": "tank"}],
}


def orbits(values: dict[str, float], noise_K: float, generator: np.random.Generator, count: int = 2) -> Record:
    """Return telemetry of some orbits of one sibling."""
    n = round(count * ORBIT_S / SAMPLING_S)
    time_s = SAMPLING_S * np.arange(n)
    phase = (time_s + generator.uniform(0, ORBIT_S)) % ORBIT_S / ORBIT_S
    sun = np.where(phase < 0.62, 160.0, 60.0)
    heater = np.where((phase * 7).astype(int) % 3 == 0, 15.0, 4.0)
    state = np.array([268.0, 269.0, 270.0]) + generator.normal(0, 1.0, 3)
    c = np.array([values["C:px"], values["C:mid"], values["C:tank"]])
    read = np.empty((n, 3))
    for k in range(n):
        read[k] = state
        for _ in range(round(SAMPLING_S / EULER_S)):
            outer = values["G:px|mid"] * (state[1] - state[0])
            inner = values["G:mid|tank"] * (state[2] - state[1])
            cold = SIGMA * 0.8 * 0.35 * (2.7**4 - state[0] ** 4)
            state = state + EULER_S / c * np.array([sun[k] + outer + cold, inner - outer, heater[k] - inner])
    read += generator.normal(0.0, noise_K, read.shape)
    columns = {"T_px": read[:, 0], "T_mid": read[:, 1], "T_tank": read[:, 2], "Q": sun, "H": heater}
    return Record(time_s, columns, None, "orbits")


def run(count: int, noise_K: float, spread: float, odd: int, seed: int) -> dict[str, Any]:
    """Return errors in ln of the parameters, alone and as a family, and who was called different."""
    generator = np.random.default_rng(seed)
    spec = load_spec(SPEC)
    truths, models = {}, {}
    for k in range(count):
        values = {name: value * float(np.exp(generator.normal(0, spread))) for name, value in TRUTH.items()}
        if k < odd:
            values["G:mid|tank"] *= 0.5
        truths[f"s{k}"] = values
        models[f"s{k}"] = calibrate(spec, [orbits(values, noise_K, generator)])
    begun = time.perf_counter()
    family = pool(models)
    elapsed_s = time.perf_counter() - begun
    alone, shared, inside = [], [], []
    for name, values in truths.items():
        member = family.members[name]
        for parameter, value in values.items():
            alone.append(np.log(models[name].values[parameter] / value))
            shared.append(np.log(member.values[parameter] / value))
            inside.append(member.low[parameter] <= value <= member.high[parameter])
    called = {(name, parameter) for name, member in family.members.items() for parameter in member.differs}
    right = {(f"s{k}", "G:mid|tank") for k in range(odd)}
    return {
        "alone": float(np.sqrt(np.mean(np.square(alone)))),
        "family": float(np.sqrt(np.mean(np.square(shared)))),
        "coverage": float(np.mean(inside)),
        "found": len(called & right),
        "wrong": len(called - right),
        "elapsed_s": elapsed_s,
    }


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--siblings", type=int, default=50)
    arguments = parser.parse_args()
    rows = []
    for noise_K, spread, odd in ((0.5, 0.02, 0), (0.5, 0.05, 0), (0.1, 0.02, 2)):
        made = run(arguments.siblings, noise_K, spread, odd, seed=1)
        rows.append(
            [
                f"{noise_K:g}",
                f"{100 * spread:g} %",
                str(odd),
                f"{100 * made['alone']:.1f} %",
                f"{100 * made['family']:.1f} %",
                f"{made['alone'] / made['family']:.1f}",
                f"{100 * made['coverage']:.0f} %",
                f"{made['found']} / {made['wrong']}",
            ]
        )
        print(rows[-1], flush=True)
    head = [
        "noise K",
        "spread",
        "odd ones",
        "error alone",
        "in the family",
        "ratio",
        "95 % covers",
        "odd found / wrong",
    ]
    note = (
        f"{arguments.siblings} siblings of one design (3 nodes, 5 parameters), two orbits of telemetry at 60 s each. Error: root "
        "mean square of ln(estimate / truth) over all siblings and parameters. An odd one has half of one conductance; wrong are "
        "parameters that were called different and are not."
    )
    save_table("family", "A family of spacecraft", markdown_table(head, rows), "benchmarks.family", note)


if __name__ == "__main__":
    main()
