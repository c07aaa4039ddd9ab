"""The closed loop on measured telemetry: rigs, houses and spacecraft, each with a part held out that no choice has seen.

``python -m benchmarks.measured_sets [--data DIR] [--only SUBSTRING ...] [--deadline S] [--cache FILE] [--fresh]
[--processes N]`` runs every split in a process of its own and saves ``benchmarks/tables/measured_sets.md``. A run that fails,
dies or hangs is a row. Finished runs stand in the cache; they are run again where the code differs, or where a deadline cut
them and another one is given. With ``--only`` the tables of these splits are printed and nothing is saved. The data are not
part of the repository: sets that are absent are left out with a reason.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.markdown import save_table
from benchmarks.measured_run import Result, measure_all
from benchmarks.measured_splits import DATA, SPLITS, Split
from benchmarks.measured_table import figures_table, in_one_line, main_table, pairs_table, summary

CACHE = Path("build/measured_sets.jsonl")
DEADLINE_S = 300.0
TITLE = "Closed loop on measured telemetry, held-out rmse"
LEGEND = (
    "`before` is the declared model at its best, `after` the one with what was found; both are open-loop rollouts. `others` are"
    " the quick fits and models that came with the data. `worse after`: by more than 0.1 %."
)
RUNS_TITLE = "## Every ordered pair of runs of the temperature lab"
RUNS_WORDS = "Each of the 13 runs alone trains a model that predicts the 12 others; errors are over all of them."
PAIRS_WORDS = (
    "Trained on the run in the row, predicted the run in the column: before → after, K; bold where worse after."
)


def chosen(only: Sequence[str]) -> list[Split]:
    """Return the splits whose names hold any of some words, all of them without words."""
    return [s for s in SPLITS if not only or any(word.lower() in s.name.lower() for word in only)]


def present(splits: Sequence[Split], data: Path) -> list[Split]:
    """Return the splits whose data are there; say which are not."""
    there = [split for split in splits if (data / split.folder).is_dir()]
    for split in splits:
        if split not in there:
            print(f"{split.name}: left out, its data are not here")
    return there


def page(results: Sequence[Result], splits: Sequence[Split], data: Path, note: str = "") -> str:
    """Return every table, a note and the summary as markdown, in the order of the splits."""
    by_name = {result.name: result for result in results}
    ordered = [by_name[split.name] for split in splits]
    others = {split.name: split.reference(data / split.folder) for split in splits}
    single = {split.name for split in splits if split.every_pair}
    sets, runs = ([r for r in ordered if (r.name in single) == alone] for alone in (False, True))
    parts = [
        *((main_table(sets, others), LEGEND, _deadlines(ordered), note) if sets else ()),
        "## Figures to reach",
        figures_table(ordered),
        *((RUNS_TITLE, RUNS_WORDS, main_table(runs, others), PAIRS_WORDS, pairs_table(runs)) if runs else ()),
        "## Summary",
        summary(ordered),
    ]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _deadlines(results: Sequence[Result]) -> str:
    seconds = sorted({result.deadline_s for result in results})
    told = " or ".join(f"{s:g}" for s in seconds)
    return f"Each search had a deadline of {told} s{', as its note tells where it ended there' if len(seconds) > 1 else ''}."


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the measured sets")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="SUBSTRING", help="only splits with this in their name"
    )
    parser.add_argument("--deadline", type=float, default=DEADLINE_S, metavar="S", help="seconds for each search")
    parser.add_argument("--cache", type=Path, default=CACHE, metavar="FILE", help="finished runs, as JSON lines")
    parser.add_argument("--fresh", action="store_true", help="run again what the cache holds")
    parser.add_argument("--processes", type=int, default=1, metavar="N", help="runs at a time, one thread each")
    parser.add_argument("--note", default="", help="what a reader should know, such as what else the machine did")
    given = parser.parse_args(words)
    splits = present(chosen(given.only), given.data)
    if not splits:
        parser.exit(1, "nothing to run\n")
    results = []
    for result in measure_all(
        splits,
        given.data,
        deadline_s=given.deadline,
        cache=given.cache,
        fresh=given.fresh,
        n_processes=given.processes,
    ):
        results.append(result)
        print(in_one_line(result), flush=True)
    text = page(results, splits, given.data, given.note)
    if not given.only:
        save_table("measured_sets", TITLE, text, "benchmarks.measured_sets")
    print(text)


if __name__ == "__main__":
    main()
