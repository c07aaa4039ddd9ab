"""What every threshold of the closed loop does: off, half and double, on the same cases.

``python -m benchmarks.ablation --cases DIR [--limit N] [--only THRESHOLD ...] [--processes 2] [--cache FILE]`` runs the closed
loop over the cases that ``python -m benchmarks.cases --out DIR`` has written, of two seeds say, once as it is and once for every
threshold and value, and saves ``benchmarks/tables/ablation.md``. Finished runs stand in the cache; an interrupted one goes on
where it was.
"""

import argparse
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from benchmarks.case import read_case
from benchmarks.loop import HOLDOUT, place, run_all
from benchmarks.markdown import commit, markdown_table, save_table
from twin_core.closed_loop import close_loop
from twin_core.discover import policy

AS_IT_IS = "as it is"
VARIANTS = ("off", "half", "double")


@dataclass(frozen=True)
class Setting:
    """One threshold at one value; ``threshold`` is empty where everything is as it is."""

    threshold: str = ""
    variant: str = AS_IT_IS

    @property
    def value(self) -> float:
        """Return the value."""
        return float(getattr(policy.THRESHOLDS[self.threshold], self.variant))


def settings(only: Sequence[str] = ()) -> list[Setting]:
    """Return how it is, and every threshold, or only some, in its three other values."""
    names = [name for name in policy.THRESHOLDS if not only or name in only]
    return [Setting(), *(Setting(name, variant) for name in names for variant in VARIANTS)]


@dataclass(frozen=True)
class Job:
    """One case under one setting, on the code of one commit."""

    path: Path
    setting: Setting
    commit: str

    @property
    def name(self) -> str:
        """Return a name that is unique among all runs."""
        return f"{self.path.stem} {self.setting.threshold} {self.setting.variant} {self.commit}"

    @property
    def group(self) -> str:
        """Return the group of its case."""
        return self.path.stem.split("-")[0]


def chosen(folder: Path, limit: int) -> list[Path]:
    """Return the cases of a folder, so many of each group at most."""
    paths = sorted(folder.glob("*.pickle"))
    return [
        path for _, group in groupby(paths, key=lambda p: p.stem.split("-")[0]) for path in list(group)[: limit or None]
    ]


def run(job: Job) -> dict[str, Any]:
    """Run one case with one threshold at one value; return what came of it."""
    begun = time.perf_counter()
    case, _ = read_case(job.path)
    threshold = job.setting.threshold
    before = getattr(policy, threshold, None)
    if threshold:
        setattr(policy, threshold, job.setting.value)
    try:
        report = close_loop(case.spec, [case.record], holdout=HOLDOUT).report
    finally:
        if threshold:
            setattr(policy, threshold, before)
    truths = {place({"effect": truth.effect, "where": truth.where}) for truth in case.truths}
    named = {place(row) for row in report["findings"]}
    return {
        "task": job.name,
        "case": job.path.stem,
        "threshold": threshold,
        "variant": job.setting.variant,
        "right": named == truths,
        "missed": len(truths - named),
        "extra": len(named - truths),
        "worse": bool(report["after"]["rmse_K"] > 1.001 * report["before"]["rmse_K"]),
        "seconds": round(time.perf_counter() - begun, 1),
    }


def row_of(runs: Iterable[dict[str, Any]]) -> list[str]:
    """Return what came of the cases of one setting: right and nothing else, effects missed, extra names, worse predictions."""
    runs = list(runs)
    right, total = sum(r["right"] for r in runs), len(runs)
    return [f"{right} of {total}", *(str(sum(r[key] for r in runs)) for key in ("missed", "extra", "worse"))]


def told(row: dict[str, Any]) -> str:
    """Return a run in one line."""
    answer = "right" if row["right"] else f"{row['missed']} missed, {row['extra']} extra"
    return f"{row['case']} {row['threshold']} {row['variant']}: {answer}{', worse' if row['worse'] else ''}"


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=Path, required=True, help="folder of python -m benchmarks.cases")
    parser.add_argument("--limit", type=int, default=0, help="so many cases of every group at most")
    parser.add_argument("--only", nargs="+", default=(), choices=list(policy.THRESHOLDS))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path("ablation.jsonl"), help="finished runs, as JSON lines")
    arguments = parser.parse_args()
    state, paths, each = commit(), chosen(arguments.cases, arguments.limit), settings(arguments.only)
    jobs = [Job(path, setting, state) for setting in each for path in paths]
    runs = [row for row in run_all(jobs, arguments.cache, arguments.processes, run, told) if "error" not in row]
    rows = []
    for setting in each:
        about = policy.THRESHOLDS.get(setting.threshold)
        value = "" if about is None else f"{getattr(policy, setting.threshold):g} → {setting.value:g} {about.unit}"
        mine = [r for r in runs if (r["threshold"], r["variant"]) == (setting.threshold, setting.variant)]
        rows.append([setting.threshold or "none", setting.variant, value, *row_of(mine)])
    header = ["threshold", "variant", "value", "right and nothing else", "effects missed", "extra names", "after worse"]
    cases = "Cases: " + ", ".join(path.stem for path in paths) + "."
    table = markdown_table(header, rows)
    save_table("ablation", "Every threshold off, half and double", table, "benchmarks.ablation", cases)


if __name__ == "__main__":
    main()
