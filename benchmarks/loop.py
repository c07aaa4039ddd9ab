"""The closed loop over the suite: is the right effect named, is it listed, and is a healthy spacecraft left alone?

``python -m benchmarks.loop [--groups ...] [--networks N] [--clean N] [--effects NAME ...] [--first-seed N] [--processes 2]
[--results FILE]`` runs the cases, appends one line of JSON per case to FILE (cases already in it are not run again), and saves
``benchmarks/tables/loop.md``.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from benchmarks.bands import Row
from benchmarks.case import Case
from benchmarks.loop_cases import FIRST_SEED, GROUPS, N_CLEAN, N_NETWORKS, Task, suite
from benchmarks.loop_table import save_tables
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.summary import to_model
from twin_core.closed_loop import close_loop
from twin_core.discover.screen import screen, survey_of
from twin_core.discover.shortlist import refined
from twin_core.discover.trial import Trial, try_effects, try_on_trajectories
from twin_core.effects import REGISTRY
from twin_core.holdout import predict, split_fraction

HOLDOUT = 0.3
RESULTS = Path("build/loop.jsonl")


class Named(Protocol):
    """What one run is of: a name that is unique among all runs, and the group it is counted in."""

    @property
    def name(self) -> str: ...

    @property
    def group(self) -> str: ...


Run = TypeVar("Run", bound=Named)


def place(row: dict[str, Any]) -> tuple[str, frozenset[Any]]:
    """Return an effect's name and place as a key: a pair has no order."""
    items = row["where"].items()
    return row["effect"], frozenset((k, v if isinstance(v, str) else frozenset(v)) for k, v in items)


def run(task: Task) -> dict[str, Any]:
    """Run one case; return what came of it."""
    case = task.build()
    begun = time.perf_counter()
    report = close_loop(case.spec, [case.record], holdout=HOLDOUT).report
    seconds = time.perf_counter() - begun
    truth = None if case.effect is None else place({"effect": case.effect, "where": case.where})
    truths = {place({"effect": hidden.effect, "where": hidden.where}) for hidden in case.truths}
    findings = report["findings"]
    named = [place(row) for row in findings]
    listed = named + [place(other) for row in findings for other in row["alternatives"]]
    own = next((row for row in findings if place(row) == truth), None)
    return {
        "task": task.name,
        "group": task.group,
        "effect": case.effect,
        "where": case.where,
        "truth": case.parameters,
        "n_nodes": len(case.spec.nodes),
        "n_samples": int(case.record.time_s.size),
        "span_s": float(np.ptp(case.record.time_s)),
        "verdict": report["verdict"],
        "first": bool(named) and named[0] == truth,
        "listed": truth in listed,
        "n_hidden": len(truths),
        "n_right": len(truths & set(named)),
        "n_wrong": len({name for name in named if name[0] != "learned_heat_flow"} - truths),  # which claims no law
        "findings": [
            {key: row[key] for key in ("effect", "where", "parameters", "evidence", "alternatives")} for row in findings
        ],
        "own": None if own is None else own["parameters"],
        "onset_error": onset_error(case, own),
        "not_supported": report["not_supported"][:3],
        "before_K": report["before"]["rmse_K"],
        "after_K": report["after"]["rmse_K"],
        "known_K": known_effect_error(case) if task.group in ("network", "fem") else None,
        "noise_K": report["noise_floor_K"],
        "seconds": seconds,
    }


def onset_error(case: Case, own: dict[str, Any] | None) -> float | None:
    """Return how far off a found onset is, as a share of the record; None where there is none."""
    if own is None or case.onset_s is None:
        return None
    found = case.record.locate_s(own["parameters"]["time"]["mean"])
    return float(abs(found - case.onset_s) / np.ptp(case.record.time_s))


def known_effect_error(case: Case) -> float:
    """Return the held-out error of the model whose effect and place are told, fitted to the same training part, in K."""
    best = known_effect_trial(case)
    if best is None:
        return float("nan")
    model = to_model(best.calibration(), best.present_effects)
    held = split_fraction([case.record], HOLDOUT)[1]
    residuals = [p.measured_K - p.predicted_K for p in (predict(model, h) for h in held)]
    return float(np.sqrt(np.nanmean(np.concatenate(residuals) ** 2)))


def known_effect_trial(case: Case) -> Trial | None:
    """Return the model whose effect and place are told, fitted to the training part from the best screened starts."""
    fit, calibration = fit_network(case.spec, split_fraction([case.record], HOLDOUT)[0])
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    survey = survey_of(fit)
    kind = REGISTRY[case.effect or ""]
    starts = refined(fit, [probe.effect for probe in screen(fit, survey, kind.starts(case.where, survey)).probes[:3]])
    trials = [try_effects(base, [start], n_passes=15) for start in starts]
    trials += [t for start in starts[:1] if (t := try_on_trajectories(base, [start])) is not None]
    return min(trials, key=lambda t: float(np.nansum(np.concatenate(t.calibration().residuals) ** 2)), default=None)


def run_all(
    tasks: Iterable[Run], results: Path, n_processes: int, work: Callable[[Run], Row], told: Callable[[Row], str]
) -> list[Row]:
    """Run what the file of results lacks; return the rows of all the tasks. A case that fails is a row with its error.

    ``work`` runs a case, ``told`` says in one line what came of it.
    """
    results.parent.mkdir(parents=True, exist_ok=True)
    done = {row["task"]: row for row in map(json.loads, results.read_text().splitlines())} if results.exists() else {}
    tasks = list(tasks)
    todo = [task for task in tasks if task.name not in done]
    with (
        ProcessPoolExecutor(n_processes, mp_context=get_context("spawn")) as pool,
        results.open("a", encoding="utf-8") as out,
    ):
        running = {pool.submit(work, task): task for task in todo}
        for future in as_completed(running):
            task = running[future]
            error = future.exception()
            row = {"task": task.name, "group": task.group, "error": repr(error)} if error else future.result()
            done[task.name] = row
            out.write(json.dumps(row) + "\n")
            out.flush()
            print(f"{row['task']}: {row['error']}" if error else told(row), flush=True)
    return [done[task.name] for task in tasks]


def line(row: dict[str, Any]) -> str:
    """Return a row in one line."""
    mark = (
        "ok  "
        if row["first"] or (row["effect"] is None and not row["findings"])
        else "list"
        if row["listed"]
        else "MISS"
    )
    found = "; ".join(f"{f['effect']} {where_in_words(f['where'])}" for f in row["findings"]) or row["verdict"]
    errors = f"{row['before_K']:.3f} -> {row['after_K']:.3f}"
    seconds = f"(known {row['known_K']}) | {row['seconds']:.1f} s"
    return f"{mark} {row['task']} {where_in_words(row['where'])}: {found} | {errors} {seconds}"


def where_in_words(where: dict[str, Any]) -> str:
    """Return where an effect acts: ``px,space``; a pair as ``px-mx``."""
    return ",".join("-".join(v) if isinstance(v, list) else str(v) for v in where.values())


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", nargs="+", default=list(GROUPS), choices=GROUPS)
    parser.add_argument("--networks", type=int, default=N_NETWORKS, help="networks per effect")
    parser.add_argument("--clean", type=int, default=N_CLEAN, help="clean records")
    parser.add_argument("--effects", nargs="+", help="only these effects")
    parser.add_argument(
        "--first-seed", type=int, default=FIRST_SEED, help="another one draws other cases: loop_SEED.md"
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    own = arguments.first_seed == FIRST_SEED
    size = {"n_networks": arguments.networks, "n_clean": arguments.clean}
    tasks = suite(arguments.groups, **size, first_seed=arguments.first_seed)
    tasks = [task for task in tasks if not arguments.effects or task.effect in arguments.effects]
    rows = run_all(tasks, arguments.results, arguments.processes, run, line)
    if not arguments.effects:
        save_tables(rows, "loop" if own else f"loop_{arguments.first_seed}")


if __name__ == "__main__":
    main()
