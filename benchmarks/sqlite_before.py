"""The store on a SQLite file, now and at an earlier commit, in turn in one run: does serving fleets slow one machine down?

``python -m benchmarks.sqlite_before`` compares with the last commit before PostgreSQL and writes
``benchmarks/tables/sqlite_before.md``. What is compared is the processor time of a batch, from the queue to its commit.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from benchmarks.markdown import TABLES, markdown_table, save_table

BEFORE = "77f603b"
ROUNDS = 5
CHANNELS, TWINS = 12, 50
SHAPES = ((200, 1500), (10, 6000), (1, 6000))
"""Samples in a batch, batches."""


def batch_cost_us(rows: int, count: int) -> float:
    """Return the processor time of one acknowledged batch in microseconds."""
    from service.store import twins
    from service.store.batch import Batch
    from service.store.database import Database

    try:
        from service.store.appending import append
    except ImportError:  # where it was before
        from service.store.samples import append  # type: ignore[attr-defined,no-redef]

    rng = np.random.default_rng(0)
    specification = {"channels": {f"T_{k}": {"kind": "temperature", "unit": "K"} for k in range(CHANNELS)}, "nodes": []}
    work = []
    for k in range(count):
        time_us = (k // TWINS * rows + np.arange(rows, dtype=np.int64)) * 10**6
        work.append((1 + k % TWINS, Batch(time_us, rng.normal(290, 5, (CHANNELS, rows)), time_us)))
    with tempfile.TemporaryDirectory() as folder:
        database = Database(Path(folder) / "twin.sqlite3")
        for k in range(TWINS):
            database.submit(twins.register, f"s{k}", specification | {"twin": f"s{k}"}).result()
        done = threading.Semaphore(0)
        begun = time.process_time()
        for twin, batch in work:
            database.submit_then(lambda result, error: done.release(), append, twin, batch)
        for _ in work:
            done.acquire()
        spent = time.process_time() - begun
        database.close()
    return 1e6 * spent / count


def main() -> None:
    """Measure both in turn and write the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--before", default=BEFORE, help="commit to compare with")
    parser.add_argument("--one", action="store_true", help="only print the costs here")
    arguments = parser.parse_args()
    if arguments.one:
        print(*(batch_cost_us(*shape) for shape in SHAPES))
        return
    root = TABLES.parents[1]
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "-C", root, "archive", arguments.before], stdout=subprocess.PIPE, check=True)
        subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)
        found: dict[str, list[list[float]]] = {folder: [], str(root): []}
        for _ in range(ROUNDS):
            for place, costs in found.items():
                command = [sys.executable, "-P", __file__, "--one"]
                paths = os.pathsep.join([place, str(root)])  # the store of one place, this benchmark of the other
                said = subprocess.run(command, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, check=True)
                costs.append([float(word) for word in said.stdout.split()])
    before, now = (np.median(costs, axis=0) for costs in found.values())
    rows = [
        [f"{n} samples of {CHANNELS} channels", f"{a:.0f} µs", f"{b:.0f} µs", f"{b / a:.2f}"]
        for (n, _), a, b in zip(SHAPES, before, now, strict=True)
    ]
    note = f"Processor time of a batch from the queue to its commit, {TWINS} twins, the median of {ROUNDS} runs of each in turn."
    table = markdown_table(["a batch of", f"before ({arguments.before})", "now", "ratio"], rows)
    save_table(
        "sqlite_before",
        "The store on a SQLite file, before PostgreSQL and now",
        table,
        "benchmarks.sqlite_before",
        note,
    )


if __name__ == "__main__":
    main()
