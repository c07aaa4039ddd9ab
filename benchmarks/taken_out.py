"""Measured telemetry with a part of its declaration taken out: what is missing is known there too.

``python -m benchmarks.taken_out [--data DIR] [--only SUBSTRING ...] [--deadline S] [--processes N] [--results FILE]`` takes a
conductor or a load out of the declarations of the measured sets, one at a time, and saves ``benchmarks/tables/taken_out.md``.
Sets whose data are absent are left out. What is taken out need not be missed: other parameters may make up for it, and what is
declared of a rig or a house is a guess of those who measured it.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loop import place, run_all, where_in_words
from benchmarks.markdown import markdown_table, save_table
from benchmarks.measured_sets import present
from benchmarks.measured_splits import DATA, ONE_OF_EACH, SPLITS, Split
from twin_core.closed_loop import close_loop
from twin_core.errors import TwinError
from twin_core.network.model import build_network
from twin_core.network.spec import Conductor, Load, TwinSpec
from twin_core.telemetry import Record

SETS = (
    "three blocks: 12 h, then 12 h",
    "temperature lab: same session",
    "temperature lab: a fast and a very fast sine, then four such",
    *ONE_OF_EACH,
)
MOST_PARTS = 6
"""Parts of a declaration that are taken out at most, spread over all of them."""
DEADLINE_S = 100.0
RESULTS = Path("build/taken_out.jsonl")
BETWEEN = ("missing_conductor", "radiative_exchange")
TO_BOUNDARY = ("leak_to_boundary", "radiation_to_sink", "nonlinear_convection")


@dataclass(frozen=True)
class TakenOut:
    """One part of one declaration: the split, ``conductors`` or ``loads``, where it stands there, and what it joins or feeds."""

    group: str
    kind: str
    position: int
    words: str

    @property
    def name(self) -> str:
        """Return the set and the part."""
        return f"{self.group}: {self.words}"


def parts(spec: TwinSpec, group: str) -> list[TakenOut]:
    """Return the parts of a declaration without which it is still one: conductors, and loads whose channel no other one reads."""
    read = [load.channel for load in spec.loads]
    own = [TakenOut(group, "conductors", i, "-".join(c.between)) for i, c in enumerate(spec.conductors)]
    own += [
        TakenOut(group, "loads", i, f"{load.channel} at {load.node}")
        for i, load in enumerate(spec.loads)
        if read.count(load.channel) == 1
    ]
    left = [part for part in own if _is_declaration(without(spec, part))]
    return left[:: -(-len(left) // MOST_PARTS)]


def without(spec: TwinSpec, part: TakenOut) -> TwinSpec:
    """Return a declaration without a part."""
    kept = [one for i, one in enumerate(getattr(spec, part.kind)) if i != part.position]
    return spec.model_copy(update={part.kind: tuple(kept)})


def _is_declaration(spec: TwinSpec) -> bool:
    try:
        build_network(spec)
    except TwinError:
        return False
    return True


def places(spec: TwinSpec, part: TakenOut, records: Sequence[Record] = ()) -> set[tuple[str, frozenset[Any]]]:
    """Return names and places of the effects that would put a part back; a load that rests all along is a constant one."""
    taken: Conductor | Load = getattr(spec, part.kind)[part.position]
    if isinstance(taken, Load):
        if records and np.ptp(np.concatenate([record.values[taken.channel] for record in records])) == 0.0:
            return {place({"effect": "constant_heat_load", "where": {"node": taken.node}})}
        return {place({"effect": "channel_heat_load", "where": {"node": taken.node, "channel": taken.channel}})}
    boundaries = [end for end in taken.between if end in spec.boundaries]
    if not boundaries:
        return {place({"effect": name, "where": {"nodes": sorted(taken.between)}}) for name in BETWEEN}
    (node,) = set(taken.between) - set(boundaries)
    sink = {"radiation_to_sink": "sink"}
    return {
        place({"effect": name, "where": {"node": node, sink.get(name, "boundary"): boundaries[0]}})
        for name in TO_BOUNDARY
    }


def run(part: TakenOut, data: Path, deadline_s: float) -> dict[str, Any]:
    """Return what the loop says where a part is taken out."""
    split = next(split for split in SPLITS if split.name == part.group)
    given = split.prepare(data / split.folder)
    begun = time.perf_counter()
    report = close_loop(
        without(given.spec, part),
        given.records,
        holdout=given.holdout,
        holdout_records=given.held_out or None,
        burn_in_s=given.burn_in_s,
        deadline_s=deadline_s,
    ).report
    right = places(given.spec, part, given.records)
    found = report["findings"]
    return {
        "task": part.name,
        "group": part.group,
        "words": part.words,
        "seconds": time.perf_counter() - begun,
        "verdict": report["verdict"],
        "named": any(place(row) in right for row in found),
        "listed": any(place(row) in right for finding in found for row in (finding, *finding["alternatives"])),
        "found": "; ".join(f"{row['effect']} {where_in_words(row['where'])}" for row in found),
        "before_K": report["before"]["rmse_K"],
        "after_K": report["after"]["rmse_K"],
        "is_cut": any("the deadline ended the search" in notice for notice in report["notices"]),
    }


def verdict(row: dict[str, Any]) -> str:
    """Return in a word whether a part was named."""
    if row["named"]:
        return "named"
    if row["listed"]:
        return "an alternative"
    return "another name" if row["found"] else "nothing"


def line(row: dict[str, Any]) -> str:
    """Return a row in one line."""
    return f"{verdict(row):14} {row['task']}: {row['found'] or row['verdict']} | {row['before_K']:.3f} -> {row['after_K']:.3f}"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows as markdown, and how many there are of each kind."""
    header = ["set", "taken out", "came back", "found", "before, K", "after, K", "s"]
    told = [row for row in rows if "error" not in row]
    lines = [
        [
            row["group"],
            row["words"],
            verdict(row),
            (row["found"] or row["verdict"]) + (" (at the deadline)" if row.get("is_cut") else ""),
            f"{row['before_K']:.3f}",
            f"{row['after_K']:.3f}",
            f"{row['seconds']:.0f}",
        ]
        for row in told
    ]
    lines += [[row["group"], row["task"], "no answer", row["error"], "", "", ""] for row in rows if "error" in row]
    kinds = ("named", "an alternative", "another name", "nothing")
    counts = [[kind, f"{sum(verdict(row) == kind for row in told)} of {len(rows)}"] for kind in kinds]
    counts.append(["worse after", f"{sum(row['after_K'] > 1.001 * row['before_K'] for row in told)} of {len(rows)}"])
    return markdown_table(["what was taken out", "parts"], counts) + "\n" + markdown_table(header, lines)


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the measured sets")
    parser.add_argument("--only", nargs="+", default=[], metavar="SUBSTRING", help="only parts with this in their name")
    parser.add_argument("--deadline", type=float, default=DEADLINE_S, metavar="S", help="seconds for each search")
    parser.add_argument("--processes", type=int, default=1, metavar="N", help="searches at a time")
    parser.add_argument("--results", type=Path, default=RESULTS)
    given = parser.parse_args(words)
    splits: list[Split] = present([split for split in SPLITS if split.name in SETS], given.data)
    tasks = [part for s in splits for part in parts(s.prepare(given.data / s.folder).spec, s.name)]
    tasks = [task for task in tasks if not given.only or any(word.lower() in task.name.lower() for word in given.only)]
    work = partial(run, data=given.data, deadline_s=given.deadline)
    rows = run_all(tasks, given.results, given.processes, work, line)
    if given.only or not rows:
        print(table(rows))
    else:
        save_table(
            "taken_out", "Measured telemetry, a part of its declaration taken out", table(rows), "benchmarks.taken_out"
        )


if __name__ == "__main__":
    main()
