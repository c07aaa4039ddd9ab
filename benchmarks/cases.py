"""Cases of the suites on disk, simulated once and for all: plain Python objects and arrays that any later code can load.

``python -m benchmarks.cases --out DIR [--groups ...] [--first-seed N] [--networks N] [--clean N] [--effects NAME ...]
[--limit N] [--workers 1]`` writes one pickle per case; those that are there already are left alone.
"""

import argparse
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from benchmarks.case import save_case
from benchmarks.loop_cases import FIRST_SEED, GROUPS, N_CLEAN, N_NETWORKS, Task, suite


def write(task: Task, folder: Path) -> str:
    """Build one case and write it; return one line of what it is."""
    begun = time.perf_counter()
    case = task.build()
    seconds = time.perf_counter() - begun
    save_case(case, path_of(task, folder), name=task.name, group=task.group, seed=task.seed, seconds=seconds)
    traces = ", ".join(f"{t.effect} {t.where} trace {t.trace:.1f}" for t in case.truths) or "healthy"
    return f"{task.name}: {traces}; {case.record.time_s.size} samples, {seconds:.1f} s"


def path_of(task: Task, folder: Path) -> Path:
    """Return where a case is kept."""
    return folder / f"{task.name.replace(':', '-')}.pickle"


def write_all(tasks: Sequence[Task], folder: Path, n_workers: int) -> None:
    """Write the cases that the folder lacks; a case that fails is told and does not stop the others."""
    folder.mkdir(parents=True, exist_ok=True)
    todo = [task for task in tasks if not path_of(task, folder).exists()]
    with ProcessPoolExecutor(n_workers, mp_context=get_context("spawn")) as pool:
        running = {pool.submit(write, task, folder): task for task in todo}
        for future in as_completed(running):
            error = future.exception()
            print(f"{running[future].name}: {error!r}" if error else future.result(), flush=True)


def main() -> None:
    """Write cases from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--groups", nargs="+", default=list(GROUPS), choices=GROUPS)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--networks", type=int, default=N_NETWORKS, help="networks per effect")
    parser.add_argument("--clean", type=int, default=N_CLEAN, help="clean records")
    parser.add_argument("--effects", nargs="+", help="only these effects")
    parser.add_argument("--limit", type=int, help="so many cases of every group at most")
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    sizes = {"n_networks": arguments.networks, "n_clean": arguments.clean, "first_seed": arguments.first_seed}
    tasks = [task for group in arguments.groups for task in suite([group], **sizes)[: arguments.limit]]
    if arguments.effects:
        tasks = [task for task in tasks if task.effect in arguments.effects]
    write_all(tasks, arguments.out, arguments.workers)


if __name__ == "__main__":
    main()
