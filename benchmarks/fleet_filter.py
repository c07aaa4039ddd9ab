"""The live filter of many twins beside that of one: processor time per twin and sample, side by side in one run.

``python -m benchmarks.fleet_filter`` writes ``benchmarks/tables/fleet_filter.md``.
"""

import argparse
import os
import time

import numpy as np

from benchmarks.fleet_world import N_NODES, NOISE_K, flight, model_of, specification
from benchmarks.markdown import markdown_table, save_table
from service.live.engine import TOGETHER
from twin_core.assimilate import Assimilation, assimilate
from twin_core.assimilate.together import Member, Question, assimilate_together
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

EVERY_S = 10.0


def filter_cost_s(n_twins: int, n_models: int, n_alone: int, every_s: float) -> tuple[float, float]:
    """Return the processor time per twin and sample of the live filter, of many twins together and of each by itself.

    Both go through the same samples from the same states; ``n_models`` spacecraft of one design stand for ``n_twins`` twins,
    each of which has telemetry of its own. Results that differ by more than 1e-9 K end the benchmark.
    """
    models = [model_of(load_spec(specification(f"sat-{k}")), np.random.default_rng(k)) for k in range(n_models)]
    members = [Member.of(model) for model in models]
    covariance = np.diag(np.full(N_NODES, NOISE_K**2)).tolist()
    rng = np.random.default_rng(0)
    records, states = [], []
    for k in range(n_twins):
        if k < n_models:
            columns = flight(models[k], every_s * np.arange(4), rng)
        else:
            own = records[k % n_models].values.items()
            columns = {name: column + NOISE_K * rng.normal(size=4) * (name[0] == "T") for name, column in own}
        records.append(Record(every_s * np.arange(4), columns))
        mean_K = [float(columns[f"T{i}"][0]) for i in range(N_NODES)]
        nodes = list(members[k % n_models].network.nodes)
        states.append({"time_s": 0.0, "nodes": nodes, "mean_K": mean_K, "covariance_K2": covariance})
    spent = []
    for step in range(3):
        rows = np.arange(step, step + 2)
        questions = [
            Question(members[k % n_models], record.take(rows), state)
            for k, (record, state) in enumerate(zip(records, states, strict=True))
        ]
        begun = time.process_time()
        found = [assimilate_together(questions[k : k + TOGETHER]) for k in range(0, n_twins, TOGETHER)]
        spent.append(time.process_time() - begun)
        done = [one for batch in found for one in batch if isinstance(one, Assimilation)]
        assert len(done) == n_twins
        if step == 1:  # the first step finds the modes of every twin
            begun = time.process_time()
            single = [assimilate(models[k % n_models], *questions[k][1:]) for k in range(n_alone)]
            alone_s = (time.process_time() - begun) / n_alone
            for one, other in zip(single, done, strict=False):
                np.testing.assert_allclose(other.mean_K, one.mean_K, rtol=0.0, atol=1e-9)
        states = [one.state for one in done]
    return sum(spent[1:]) / (2 * n_twins), alone_s


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--twins", type=int, default=10_000)
    n_twins = parser.parse_args().twins
    load = os.getloadavg()[0]
    together_s, alone_s = filter_cost_s(n_twins, min(1000, n_twins), 200, EVERY_S)
    share = 100.0 * n_twins / EVERY_S / 2.0
    rows = [
        ["core time per twin and sample", f"{1e6 * together_s:.0f} µs", f"{1e6 * alone_s:.0f} µs", f"{alone_s / together_s:.1f}"],
        ["share of two cores at 0.1 Hz", f"{share * together_s:.0f} %", f"{share * alone_s:.0f} %", ""],
    ]  # fmt: skip
    table = markdown_table([f"{n_twins:,} twins of {N_NODES} nodes", "together", "each by itself", "ratio"], rows)
    note = (
        "Processor time of one thread, telemetry as arrays in and assimilations out: what the service spends on the store and on "
        f"looking for anomalies comes on top. Load average {load:.0f} on two cores."
    )
    print(table)
    save_table("fleet_filter", "The live filter of many twins", table, "benchmarks.fleet_filter", note)


if __name__ == "__main__":
    main()
