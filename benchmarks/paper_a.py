"""Paper A side by side: Sosta et al. (arXiv 2605.28452), tables 1 to 5, section 5.7, and speed.

``python -m benchmarks.paper_a`` writes ``benchmarks/tables/paper_a_*.md``; ``--help`` tells the rest.
"""

import argparse
from collections.abc import Callable

from benchmarks import paper_a_memory, paper_a_rollout, paper_a_speed, paper_a_stability, paper_a_tables
from benchmarks.markdown import save_table

TITLES = {
    "memory": "Paper A, calibration of a million samples",
    "tables": "Paper A, tables 1 to 3: external, internal and combined forcing",
    "windows": "Paper A, table 4: window length",
    "noise": "Paper A, table 5: noise on the labels",
    "stability": "Paper A, section 5.7: ten runs at 1 % noise",
    "speed": "Paper A, speed: calibration and finite elements",
    "rollout": "Paper A, speed: rollouts",
}


def main() -> None:
    """Run what was asked for and save it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", nargs="+", choices=tuple(TITLES), default=list(TITLES), help="some sections only")
    parser.add_argument("--iterations", type=int, default=2000, help="of the paper's recipe")
    parser.add_argument(
        "--budget", type=float, default=900.0, help="seconds that the recipe may take in the speed table"
    )
    parser.add_argument("--recipe", choices=("none", "one", "all"), default="one", help="where tables 1 to 3 run it")
    options = parser.parse_args()
    cases = {"none": [], "one": [("combined", "A")], "all": list(paper_a_tables.PUBLISHED)}[options.recipe]
    sections: dict[str, Callable[[], tuple[str, str]]] = {
        "memory": lambda: (paper_a_memory.memory(), ""),  # first, before anything else has used some
        "tables": lambda: (paper_a_tables.tables_1_to_3(cases, options.iterations), paper_a_tables.NOTE),
        "windows": lambda: (paper_a_tables.table_4(options.iterations), paper_a_tables.NOTE),
        "noise": lambda: (paper_a_tables.table_5(), paper_a_tables.NOTE),
        "stability": lambda: (paper_a_stability.stability(), ""),
        "speed": lambda: (
            paper_a_speed.calibration(options.iterations, options.budget) + "\n" + paper_a_speed.finite_elements(),
            "",
        ),
        "rollout": lambda: (paper_a_rollout.rollouts() + "\n" + paper_a_rollout.growth(), ""),
    }
    for name, section in sections.items():
        if name in options.only:
            text, note = section()
            save_table(f"paper_a_{name}", TITLES[name], text, "benchmarks.paper_a", note)


if __name__ == "__main__":
    main()
