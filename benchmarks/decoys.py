"""Decoys: how often is a channel named that has nothing to do with the spacecraft?

Beside every driving channel of a record (power, auxiliary, temperature of a boundary) a twin is declared as an auxiliary
channel: the same values circularly shifted in time where the channel takes few values, else with its phases randomised, so
that mean, variance and spectrum are those of the original (Theiler et al., Physica D 58 (1992) 77). No heat follows it. A run
in which a finding names a decoy is a false discovery whatever else is in the record, so measured telemetry can be used too.
The bound is that of Clopper and Pearson (Biometrika 26 (1934) 404), one-sided, at 95 %.

``python -m benchmarks.decoys [--groups clean network measured] [--runs N] [--first-seed N] [--only SUBSTRING ...]
[--deadline S] [--results FILE] [--processes 1]`` runs the cases that FILE lacks, and saves ``benchmarks/tables/decoys.md``
from all that it holds.
"""

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

from benchmarks.bands import Row
from benchmarks.loop_cases import Task, suite
from benchmarks.markdown import markdown_table, save_table
from benchmarks.measured_splits import DATA, SPLITS, Prepared
from twin_core.closed_loop import close_loop
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec, load_spec
from twin_core.telemetry import Record

FEW_VALUES = 12
"""A channel with no more values than these is shifted: with random phases it would not be a switch any more."""
LEAST_SHIFT = 0.1
"""Share of the record by which a shifted twin is off at least, either way."""
PREFIX = "decoy_"
GROUPS = ("clean", "network", "measured")
RESULTS = Path("build/decoys.jsonl")
FIRST_SEED = 7000
LEVEL = 0.95
HOLDOUT = 0.3

Column = np.ndarray[Any, np.dtype[np.float64]]


def twin_of(column: Column, rng: np.random.Generator, *, levels: bool) -> Column:
    """Return a column (n_times,) with the spectrum of another and nothing else of it; missing samples hold the one before."""
    known = np.flatnonzero(np.isfinite(column))
    filled = column[known[np.maximum(np.searchsorted(known, np.arange(column.size), side="right") - 1, 0)]]
    if levels or np.unique(filled).size <= FEW_VALUES:
        least = max(int(LEAST_SHIFT * filled.size), 1)
        return np.roll(filled, int(rng.integers(least, max(filled.size - least, least + 1))))
    spectrum = np.fft.rfft(filled)
    turn = np.exp(2j * np.pi * rng.random(spectrum.size))
    turn[0] = 1.0  # the mean stays
    if filled.size % 2 == 0:
        turn[-1] = rng.choice([-1.0, 1.0])  # its own conjugate
    return np.fft.irfft(spectrum * turn, filled.size)


def candidates(spec: TwinSpec, records: Sequence[Record]) -> list[str]:
    """Return the driving channels that every record has and that move in one of them."""
    boundaries = {b.channel for b in spec.boundaries.values()}
    named = [
        n for n, c in spec.channels.items() if n not in spec.sensors and (c.kind != "temperature" or n in boundaries)
    ]
    there = [n for n in named if all(n in r.values and np.isfinite(r.values[n]).any() for r in records)]
    return [n for n in there if any(np.nanmax(r.values[n]) > np.nanmin(r.values[n]) for r in records)]


def with_decoys(prepared: Prepared, seed: int) -> Prepared:
    """Return a case with a twin declared and recorded beside every driving channel."""
    rng = np.random.default_rng([seed, 58])
    names = candidates(prepared.spec, [*prepared.records, *prepared.held_out])
    plain = dump_spec(prepared.spec)
    channels = dict(plain["channels"])
    for name in names:
        levels = bool(channels[name].get("levels"))
        channels[PREFIX + name] = {"kind": "auxiliary"} | ({"levels": True} if levels else {})

    def widened(record: Record) -> Record:
        twins = {PREFIX + n: twin_of(record.values[n], rng, levels=bool(channels[n].get("levels"))) for n in names}
        return replace(record, values={**record.values, **twins})

    spec = load_spec(plain | {"channels": channels})
    held_out = [widened(r) for r in prepared.held_out]
    return replace(prepared, spec=spec, records=[widened(r) for r in prepared.records], held_out=held_out)


def decoys_named(findings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the findings that name a decoy, in words."""
    return [f"{f['effect']}({f['where']['channel']})" for f in findings if _is_decoy(f["where"])]


def _is_decoy(where: Mapping[str, Any]) -> bool:
    return str(where.get("channel", "")).startswith(PREFIX)


@dataclass(frozen=True)
class MeasuredTask:
    """A measured split under the name of the suite's tasks."""

    split: str
    data: Path
    group: str = "measured"

    @property
    def name(self) -> str:
        """Return a name that is unique among all tasks."""
        return f"{self.group}:{self.split}"

    def prepare(self) -> Prepared:
        """Read the telemetry."""
        split = next(s for s in SPLITS if s.name == self.split)
        return split.prepare(self.data / split.folder)


def prepared_of(task: Task | MeasuredTask) -> tuple[Prepared, int]:
    """Return what the closed loop is given, and the seed of its decoys."""
    if isinstance(task, MeasuredTask):
        return task.prepare(), [s.name for s in SPLITS].index(task.split)
    case = task.build()
    return Prepared(case.spec, [case.record], holdout=HOLDOUT), task.seed


def run(task: Task | MeasuredTask, deadline_s: float | None = None) -> Row:
    """Close the loop on one case with decoys; return what it named."""
    plain, seed = prepared_of(task)
    prepared = with_decoys(plain, seed)
    begun = time.perf_counter()
    report = close_loop(
        prepared.spec,
        prepared.records,
        holdout=prepared.holdout,
        holdout_records=prepared.held_out or None,
        burn_in_s=prepared.burn_in_s,
        deadline_s=deadline_s,
    ).report
    findings = report["findings"]
    return {
        "task": task.name,
        "group": task.group,
        "n_decoys": len(prepared.spec.channels) - len(plain.spec.channels),
        "n_findings": len(findings),
        "findings": [{key: f[key] for key in ("effect", "where")} for f in findings],
        "named": decoys_named(findings),
        "alternatives": [a for f in findings for a in decoys_named(f["alternatives"])],
        "seconds": time.perf_counter() - begun,
    }


def upper_bound(k: int, n: int, level: float = LEVEL) -> float:
    """Return the one-sided upper confidence bound of a share of which k of n were seen."""
    return 1.0 if k >= n else float(beta.ppf(level, k + 1, n - k))


def table(rows: Sequence[Row]) -> str:
    """Return the shares by group, and every run that named a decoy."""
    good = [row for row in rows if "error" not in row]
    groups = {name: [r for r in good if r["group"] == name] for name in GROUPS}
    groups["all"] = good
    lines = []
    for name, some in groups.items():
        if not some:
            continue
        k, n = sum(bool(r["named"]) for r in some), len(some)
        beside = sum(bool(r["alternatives"]) for r in some)
        lines.append(
            [
                name,
                str(n),
                str(sum(r["n_decoys"] for r in some)),
                f"{100 * k / n:.1f} % ({k}/{n})",
                f"{100 * upper_bound(k, n):.1f} %",
                str(beside),
                f"{float(np.median([r['seconds'] for r in some])):.1f}",
            ]
        )
    header = ["records", "runs", "decoys", "a decoy named", "upper 95 % bound", "as an alternative", "median s"]
    named = [[r["task"], "; ".join(r["named"])] for r in good if r["named"]]
    failed = [[r["task"], r["error"]] for r in rows if "error" in r]
    parts = [markdown_table(header, lines)]
    parts += ["## Decoys that were named", markdown_table(["run", "finding"], named)] if named else []
    parts += ["## Runs that failed", markdown_table(["run", "error"], failed)] if failed else []
    return "\n\n".join(part.strip() for part in parts) + "\n"


def tasks_of(
    groups: Sequence[str], n_runs: int, first_seed: int, only: Sequence[str] = (), data: Path = DATA
) -> list[Task | MeasuredTask]:
    """Return the tasks: so many clean records, one network per effect after the other, every measured split that is there.

    Of the splits that train on one run of the temperature lab none takes part: thirteen runs of one device would count as
    thirteen records.
    """
    tasks: list[Task | MeasuredTask] = []
    if "clean" in groups:
        tasks += suite(["clean"], n_clean=n_runs, first_seed=first_seed)
    if "network" in groups:
        per_effect = suite(["network"], n_networks=-(-n_runs // 20), first_seed=first_seed)
        tasks += sorted(per_effect, key=lambda t: t.seed % 10)[:n_runs]
    if "measured" in groups:
        splits = [s for s in SPLITS if not s.every_pair and (data / s.folder).is_dir()]
        tasks += [MeasuredTask(s.name, data) for s in splits]
    return [t for t in tasks if not only or any(word.lower() in t.name.lower() for word in only)]


def line(row: Row) -> str:
    """Return a row in one line."""
    told = "; ".join(row["named"]) or "no decoy"
    return f"{row['task']}: {told}; {row['n_findings']} findings, {row['n_decoys']} decoys, {row['seconds']:.1f} s"


def main() -> None:
    """Run the benchmark from the command line."""
    from benchmarks.loop import run_all  # its plots need the benchmarks' extra, the decoys do not

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", nargs="+", default=list(GROUPS), choices=GROUPS)
    parser.add_argument("--runs", type=int, default=300, help="clean records, and networks with an effect")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--only", nargs="+", default=[], metavar="SUBSTRING", help="only tasks with this in their name")
    parser.add_argument("--deadline", type=float, metavar="S", help="seconds for each search; none by default")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the measured sets")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="run nothing, save the table of what FILE holds")
    given = parser.parse_args()
    if not given.table:
        tasks = tasks_of(given.groups, given.runs, given.first_seed, given.only, given.data)
        run_all(tasks, given.results, given.processes, partial(run, deadline_s=given.deadline), line)
    rows = [json.loads(text) for text in given.results.read_text(encoding="utf-8").splitlines()]
    text = table(list({row["task"]: row for row in rows}.values()))
    note = "A run counts once however many of its decoys are named. `as an alternative`: runs that list one beside a finding."
    save_table("decoys", "Channels that nothing follows", text, "benchmarks.decoys", note)
    print(text)


if __name__ == "__main__":
    main()
