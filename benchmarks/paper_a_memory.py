"""Memory and time of a whole calibration on a million samples of twelve channels, in a process of its own."""

import resource
import time

import numpy as np

from benchmarks.markdown import markdown_table
from twin_core.calibrate import calibrate
from twin_core.network.model import build_network
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

N_NODES = 6


def chain() -> TwinSpec:
    """Return six sensed and heated nodes in a row, all of them radiating."""
    ids = range(N_NODES)
    temperatures = {f"T{i}": {"kind": "temperature", "unit": "K", "noise_std": 0.1} for i in ids}
    return load_spec(
        {
            "twin": "chain",
            "boundaries": {"space": {"value_K": 3.0}},
            "channels": temperatures | {f"Q{i}": {"kind": "power", "unit": "W"} for i in ids},
            "nodes": [{"id": f"n{i}", "sensor": f"T{i}", "capacity_J_per_K": {"guess": 5e3}} for i in ids],
            "conductors": [
                {"between": [f"n{i}", f"n{i + 1}"], "conductance_W_per_K": {"guess": 2.0}} for i in ids[:-1]
            ],
            "radiators": [{"node": f"n{i}", "emissivity": 0.8, "area_m2": 0.05, "sink": "space"} for i in ids],
            "loads": [{"channel": f"Q{i}", "node": f"n{i}"} for i in ids],
        }
    )


def telemetry(spec: TwinSpec, n_times: int) -> Record:
    """Return readings of the network at other parameter values, with noise."""
    rng = np.random.default_rng(0)
    heat = {f"Q{i}": np.repeat(rng.choice([5.0, 40.0], n_times // 50 + 1), 50)[:n_times] for i in range(N_NODES)}
    record = Record(20.0 * np.arange(n_times), heat)
    network = build_network(spec)
    values = network.parameters.values
    values[network.parameters.free_index] *= rng.uniform(0.6, 1.5, network.parameters.free_index.size)
    path = rollout(network, values, np.full(N_NODES, 280.0), build_forcing(network, record, np.inf))
    read = np.vstack([path.start_K, path.stages_K[:, 1]]) + 0.1 * rng.normal(size=(n_times, N_NODES))
    return Record(record.time_s, heat | {f"T{i}": read[:, i].copy() for i in range(N_NODES)})


def memory(sizes: tuple[int, ...] = (10_000, 100_000, 1_000_000)) -> str:
    """Return seconds and peak memory of calibrations of growing length."""
    rows = []
    for n_times in sizes:
        record = telemetry(chain(), n_times)
        begun = time.process_time()
        model = calibrate(chain(), [record])
        taken = time.process_time() - begun
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        rows.append(
            [
                f"{n_times:,}",
                f"{taken:.1f}",
                f"{1e6 * taken / n_times:.0f}",
                f"{model.summary['rmse_K']:.4f}",
                f"{peak:.2f}",
            ]
        )
        print(rows[-1], flush=True)
    header = ["samples of 12 channels", "seconds", "µs per sample", "rmse (K), noise 0.1 K", "peak memory (GiB)"]
    return markdown_table(header, rows)
