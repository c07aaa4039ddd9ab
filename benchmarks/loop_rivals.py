"""The closed loop beside what a user would pick instead, on the same cases in one run.

``python -m benchmarks.loop_rivals [--groups network fem clean] [--effects NAME ...] [--per-effect 1] [--processes 1]
[--results FILE]`` runs the first cases of every effect and group of the suite, appends one line of JSON per case to FILE (cases
already in it are not run again), and saves ``benchmarks/tables/loop_rivals.md`` from all that FILE holds.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bands import Row
from benchmarks.case import Case
from benchmarks.loop import HOLDOUT, place, run_all
from benchmarks.loop_cases import Task, suite
from benchmarks.markdown import markdown_table, save_table
from benchmarks.rival_bic import greedy_bic
from benchmarks.rival_residual import IN_LIBRARY, Regressed, residual_polynomial, rms_error_K, sindy
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.summary import to_model
from twin_core.closed_loop import close_loop
from twin_core.discover.trial import Trial
from twin_core.holdout import split_fraction

RESULTS = Path("build/loop_rivals.jsonl")
CLEAN_PER_EFFECT = 6
"""Clean cases for every case per effect: a healthy spacecraft is not one effect among many."""

METHODS = ("closed loop", "greedy BIC", "SINDy", "residual polynomial")
NOTE = """All start from the same calibrated declared model; its calibration is part of everybody's seconds. Every model is
rolled out open loop over the last 30 % of the record, from the state filtered at the end of the training part. Only the
closed loop refits side by side on both cores.

- SINDy: pysindy's STLSQ on the residual heat of every sensed node. Library: 1, differences of T to every node and boundary
  and of T^4 to every boundary, inputs, auxiliary channels by level, the harmonic that stands out. Residual and library
  smoothed alike (Savitzky-Golay); columns scaled, centred or not; scaling, smoothing, ridge and threshold by open-loop
  validation inside the training part, "no term" among the choices. Its name is that of the largest term that the
  vocabulary has one for.
- Residual polynomial: up to third order in each node's own temperature, order and smoothing chosen likewise.
- Greedy BIC: all candidates of our registry, the six best screened places refitted in full per step on open-loop
  trajectories with our solver, white-noise BIC, four effects at most.

A false finding is a name on a clean record; of the residual polynomial, which names nothing, any correction at all."""


def rivals_of(case: Case) -> dict[str, Callable[[], tuple[Regressed, float]]]:
    """Return the rivals on a case: each gives its answer and the seconds it took, calibration included."""
    train, _ = split_fraction([case.record], HOLDOUT)
    begun = time.perf_counter()
    fit, calibration = fit_network(case.spec, train)
    model = to_model(calibration, (), uncertain=False)
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    shared = time.perf_counter() - begun

    def timed(rival: Callable[[], Regressed]) -> Callable[[], tuple[Regressed, float]]:
        def run() -> tuple[Regressed, float]:
            start = time.perf_counter()
            return rival(), shared + time.perf_counter() - start

        return run

    return {
        "before": lambda: (Regressed([], model), shared),
        "greedy BIC": timed(lambda: greedy_bic(base)),
        "SINDy": timed(lambda: sindy(calibration, model, train[0])),
        "residual polynomial": timed(lambda: residual_polynomial(calibration, model, train[0])),
    }


def run(task: Task) -> Row:
    """Run every method on one case; return what came of it."""
    case = task.build()
    _, held = split_fraction([case.record], HOLDOUT)
    methods: dict[str, Any] = {}
    for name, rival in rivals_of(case).items():
        answer, seconds = rival()
        corrected = bool(answer.model.effects)
        error = rms_error_K(answer.model, held)
        methods[name] = {"named": answer.named, "after_K": error, "corrected": corrected, "seconds": seconds}
    begun = time.perf_counter()
    loop = close_loop(case.spec, [case.record], holdout=HOLDOUT)
    seconds = time.perf_counter() - begun
    found = [{"effect": f["effect"], "where": f["where"]} for f in loop.report["findings"]]
    error = rms_error_K(loop.model, held)
    methods["closed loop"] = {"named": found, "after_K": error, "corrected": bool(found), "seconds": seconds}
    truth = None if case.effect is None else place({"effect": case.effect, "where": case.where})
    for own in methods.values():
        own["first"] = bool(own["named"]) and place(own["named"][0]) == truth
    before = methods.pop("before")
    return {
        "task": task.name,
        "group": task.group,
        "effect": case.effect,
        "where": case.where,
        "before_K": before["after_K"],
        "methods": methods,
    }


def line(row: Row) -> str:
    """Return a row in one line."""
    parts = []
    for name in METHODS:
        own = row["methods"][name]
        said = own["named"][0]["effect"] if own["named"] else "-"
        parts.append(f"{name} {'ok' if own['first'] else said} {own['after_K']:.3f} K {own['seconds']:.0f} s")
    return f"{row['task']} {row['before_K']:.3f} K: " + "; ".join(parts)


def save(rows: Sequence[Row]) -> None:
    """Save ``benchmarks/tables/loop_rivals.md`` from the rows of a run."""
    good = [row for row in rows if "error" not in row]
    groups = [group for group in ("network", "fem", "clean", "outside") if any(r["group"] == group for r in good)]
    parts = [f"## {_TITLES[g]}\n\n" + _table([r for r in good if r["group"] == g]) for g in groups]
    parts.append("## By case\n\n" + _by_case(good))
    failed = "".join(f"\n\nFailed: {row['task']}: {row['error']}" for row in rows if "error" in row)
    title = "The closed loop beside SINDy, a residual polynomial and greedy BIC"
    save_table("loop_rivals", title, "\n\n".join(parts), "benchmarks.loop_rivals", NOTE + failed)


_TITLES = {
    "network": "Network truth",
    "fem": "Finite-element truth",
    "clean": "Clean records",
    "outside": "Outside the vocabulary",
}


def _table(rows: Sequence[Row]) -> str:
    """Return one line per method over the rows of one group."""
    clean = all(row["effect"] is None for row in rows)
    within = [row for row in rows if row["effect"] in IN_LIBRARY]
    body = []
    for name in METHODS:
        own = [row["methods"][name] for row in rows]
        before = np.array([row["before_K"] for row in rows])
        after = np.array([method["after_K"] for method in own])
        names = any(method["named"] for row in rows for method in [row["methods"][name]])
        first = f"{sum(m['first'] for m in own)}/{len(own)}"
        known = f"{sum(row['methods'][name]['first'] for row in within)}/{len(within)}"
        false = sum(bool(m["named"]) if name != METHODS[-1] else m["corrected"] for m in own)
        head = [f"{false}/{len(own)}"] if clean else [first if names else "names nothing", known if names else ""]
        body.append(
            [
                name,
                *head,
                f"{np.median(before):.3f}",
                f"{np.median(after):.3f}",
                f"{np.median(after / before):.2f}",
                f"{np.sum(after > 1.001 * before)}/{len(own)}",
                f"{np.median([m['seconds'] for m in own]):.1f}",
            ]
        )
    head = ["false findings"] if clean else ["right effect and place first", "of effects in SINDy's library"]
    tail = ["before, K (median)", "after, K (median)", "after / before (median)", "worse than before", "s (median)"]
    return markdown_table(["method", *head, *tail], body)


def _by_case(rows: Sequence[Row]) -> str:
    """Return one line per case: held-out error of every method, with a star where the right name came first."""
    body = []
    for row in rows:
        cells = []
        for name in METHODS:
            own = row["methods"][name]
            wrong = own["named"] and not own["first"]
            cells.append(
                f"{own['after_K']:.3f}" + (" *" if own["first"] else f" ({own['named'][0]['effect']})" if wrong else "")
            )
        body.append([row["task"], f"{row['before_K']:.3f}", *cells])
    header = ["case", "before, K", *(f"{name}, K" for name in METHODS)]
    return (
        markdown_table(header, body)
        + "\n\\* right effect and place first; in brackets the name that came first instead.\n"
    )


def sample(groups: Sequence[str], effects: Sequence[str] | None, per_effect: int) -> list[Task]:
    """Return the first tasks of every effect, or of those named."""
    chosen: list[Task] = []
    for task in suite(tuple(groups)):
        many = per_effect * (CLEAN_PER_EFFECT if task.effect is None else 1)
        same = sum((t.group, t.effect) == (task.group, task.effect) for t in chosen)
        if same < many and (not effects or task.effect is None or task.effect in effects):
            chosen.append(task)
    return chosen


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", nargs="+", default=["network", "fem", "clean"])
    parser.add_argument("--effects", nargs="+", help="only these effects")
    parser.add_argument("--per-effect", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    tasks = sample(arguments.groups, arguments.effects, arguments.per_effect)
    run_all(tasks, arguments.results, arguments.processes, run, line)
    save([json.loads(text) for text in arguments.results.read_text().splitlines()])


if __name__ == "__main__":
    main()
