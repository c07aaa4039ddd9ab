"""Networks as decks have them: 400 nodes and 10,000 couplings, simulated and correlated.

``python -m benchmarks.large_network`` writes ``benchmarks/tables/large_network.md``. Couplings join near nodes by conduction and
any by radiation; each conductor belongs to one of 30 groups, whose factors are unknown, and 40 nodes have a sensor.
"""

import time
from typing import Any

import numpy as np

from benchmarks.markdown import markdown_table, save_table
from twin_core.calibrate import calibrate
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

N_NODES, N_COUPLINGS, N_GROUPS, N_SENSORS = 400, 10_000, 30, 40
ORBIT_S, SIMULATED_ORBITS, CORRELATED_ORBITS = 5600.0, 15, 5
STEP_S, SAMPLE_S, NOISE_K = 30.0, 280.0, 0.05


def declared(seed: int = 0) -> dict[str, Any]:
    """Return a specification in which every number but the factors of the groups is known."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(size=(N_NODES, 3))
    first, second = np.triu_indices(N_NODES, 1)
    near = np.argsort(((place[first] - place[second]) ** 2).sum(axis=1))
    n_space, n_linear = N_NODES // 2, N_COUPLINGS // 5
    seen = rng.choice(first.size, N_COUPLINGS - n_linear - n_space, replace=False)

    def pair(k: int) -> list[str]:
        return [f"n{first[k]}", f"n{second[k]}"]

    def group(k: int) -> str:
        return f"g{(int(10 * place[first[k], 0]) * 3 + int(3 * place[second[k], 1])) % N_GROUPS}"

    return {
        "twin": "large",
        "boundaries": {"space": {"value_K": 3.0}},
        "channels": {f"T{i}": {"kind": "temperature", "unit": "K"} for i in range(N_SENSORS)}
        | {"Q": {"kind": "power", "unit": "W"}, "S": {"kind": "power", "unit": "W", "interpolation": "linear"}},
        "nodes": [
            {"id": f"n{i}", "capacity_J_per_K": {"value": float(rng.uniform(20.0, 400.0))}}
            | ({"sensor": f"T{i}"} if i < N_SENSORS else {})
            for i in range(N_NODES)
        ],
        "conductors": [
            {
                "between": pair(k),
                "conductance_W_per_K": {"value": float(rng.uniform(0.01, 0.5)), "scale": group(k)},
            }
            for k in near[:n_linear]
        ],
        "radiation": [
            *({"between": pair(k), "area_m2": {"value": float(rng.uniform(1e-6, 1e-4))}} for k in seen),
            *(
                {"between": [f"n{i}", "space"], "area_m2": {"value": float(rng.uniform(0.001, 0.01))}}
                for i in range(n_space)
            ),
        ],
        "loads": [
            {"channel": name, "node": f"n{i}", "gain": {"value": float(rng.uniform(0.1, 1.5))}}
            for shift, name in enumerate("QS")
            for i in range(shift, N_NODES, 4)
        ],
        "parameters": {f"g{i}": {"guess": 1.0, "spread": 1.5} for i in range(N_GROUPS)},
    }


def flight(orbits: int, step_s: float) -> Record:
    """Return inputs over some orbits: sunlight by halves of it, and electronics that are switched on."""
    time_s = np.arange(0.0, orbits * ORBIT_S, step_s)
    sun = 8.0 * np.maximum(np.sin(2.0 * np.pi * time_s / ORBIT_S), 0.0)
    return Record(time_s, {"Q": np.where(time_s > 1.6 * ORBIT_S, 5.0, 2.0), "S": sun})


def states_K(network: Network, record: Record, step_s: float) -> np.ndarray:
    """Return all nodes at the samples."""
    forcing = build_forcing(network, record, step_s)
    return rollout(network, network.parameters.values, np.full(N_NODES, 280.0), forcing).at_samples(forcing.sample_step)


def main() -> None:
    """Run the benchmark from the command line."""
    spec = load_spec(declared())
    network = build_network(spec)
    states_K(network, flight(1, ORBIT_S / 4.0), STEP_S)  # compiled before the clock starts
    began = time.process_time()
    states_K(network, flight(SIMULATED_ORBITS, STEP_S), STEP_S)
    simulated_s = time.process_time() - began
    rng = np.random.default_rng(1)
    truth = {f"g{i}": float(np.exp(rng.normal(0.0, 0.4))) for i in range(N_GROUPS)}
    record = flight(CORRELATED_ORBITS, SAMPLE_S)
    seen = states_K(network.with_parameters(network.parameters.updated(truth)), record, STEP_S)[:, :N_SENSORS]
    read = seen + rng.normal(0.0, NOISE_K, seen.shape)
    record = Record(record.time_s, {**record.values, **{f"T{i}": read[:, i] for i in range(N_SENSORS)}})
    began = time.process_time()
    model = calibrate(spec, [record])
    correlated_s = time.process_time() - began
    rows = {row["name"]: row for row in model.summary["parameters"]}
    told = [name for name in truth if rows[name]["identified"]]
    off = [abs(np.log(model.values[name] / truth[name])) for name in told]
    table = markdown_table(
        [f"{N_NODES} nodes, {N_COUPLINGS} couplings", "measured"],
        [
            [f"{SIMULATED_ORBITS} orbits simulated, a step in {STEP_S:g} s: seconds of one core", f"{simulated_s:.1f}"],
            [
                f"{N_GROUPS} groups against {N_SENSORS} sensors, {CORRELATED_ORBITS} orbits: seconds of one core",
                f"{correlated_s:.0f}",
            ],
            ["groups that the data tell", f"{len(told)} of {N_GROUPS}"],
            ["their factors are off by, median and most", f"{np.median(off):.1%}, {max(off):.1%}"],
        ],
    )
    print(table)
    note = "The factors were drawn about the guess of 1, with a deviation of 0.4 in ln. Initial temperatures are unknown too."
    save_table("large_network", "Large networks", table, "benchmarks.large_network", note)


if __name__ == "__main__":
    main()
