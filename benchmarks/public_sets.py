"""The closed loop on public measured data of other fields, which nothing here was made for.

``python -m benchmarks.public_sets [--arrays DIR] [--building DIR] [--only SUBSTRING ...] [--deadline S] [--processes N]`` closes
the loop on photovoltaic arrays (:mod:`benchmarks.photovoltaic`) and on a heated building (:mod:`benchmarks.heated_building`) with
several declarations and shares of the record held out, each in a process of its own, and saves
``benchmarks/tables/public_sets.md``. The modules tell where each folder comes from; what is not given is left out.
"""

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from benchmarks import heated_building, photovoltaic
from benchmarks.markdown import save_table
from benchmarks.measured_run import THREADS, Result, compile_all, measure, sources, supervised
from benchmarks.measured_splits import Split
from benchmarks.measured_table import in_one_line, main_table

TITLE = "Closed loop on public data of other fields, held-out rmse"
DEADLINE_S = 180.0
LEGEND = (
    "`before` is the declared model at its best, `after` the one with what was found; both are open-loop rollouts. On the arrays"
    " snow falls on a part of what is held out, of which no training part tells."
)


def summary(results: Sequence[Result]) -> str:
    """Return how many runs came to what, in one sentence."""
    found = [r for r in results if r.verdict == "effect_added"]
    better, worse = (sum(r.is_worse is worse for r in found) for worse in (False, True))
    crashed, hung = sum(r.crashed for r in results), sum(r.hung for r in results)
    return (
        f"Of {len(results)} runs {crashed} crashed, {hung} hung; in {len(found)} something was found: {better} of these predict"
        f" the hold-out better or as well, {worse} worse."
    )


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arrays", type=Path, metavar="DIR", help="folder of the files of photovoltaic arrays")
    parser.add_argument("--building", type=Path, metavar="DIR", help="folder of the building's file")
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="SUBSTRING", help="only splits with this in their name"
    )
    parser.add_argument("--deadline", type=float, default=DEADLINE_S, metavar="S", help="seconds for each search")
    parser.add_argument("--processes", type=int, default=1, metavar="N", help="searches at a time")
    given = parser.parse_args(words)
    os.environ.update(dict.fromkeys(THREADS, "1"))  # the processes that are started below inherit it
    sets: list[tuple[Split, Path]] = []
    for option, folder, files, splits in (
        ("--arrays", given.arrays, tuple(photovoltaic.COLUMNS), photovoltaic.SPLITS),
        ("--building", given.building, (heated_building.FILE,), heated_building.SPLITS),
    ):
        if folder is None:
            continue
        absent = [name for name in files if not (folder / name).is_file()]
        if absent:
            parser.error(f"{option}: {folder} lacks {', '.join(absent)}")
        sets += [(split, folder) for split in splits]
    if not sets:
        parser.error("nothing to run: give --arrays, --building or both")
    sets = [(s, folder) for s, folder in sets if any(word.lower() in s.name.lower() for word in given.only)]
    if not sets:
        parser.error(f"--only: no split has {' or '.join(given.only)} in its name")
    code = sources()
    compile_all()

    def run(one: tuple[Split, Path]) -> Result:
        split, folder = one
        result = supervised(split.name, partial(measure, split, folder, code, given.deadline), code, given.deadline)
        print(in_one_line(result), flush=True)
        return result

    with ThreadPoolExecutor(given.processes) as pool:
        results = list(pool.map(run, sets))
    page = f"{main_table(results, {})}\n{LEGEND}\n\n{summary(results)}\n"
    if given.only == [""]:
        save_table("public_sets", TITLE, page, "benchmarks.public_sets")
    else:
        print(page)


if __name__ == "__main__":
    main()
