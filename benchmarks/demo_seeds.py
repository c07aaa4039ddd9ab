"""The whole demonstration over seeds: each hides an effect in finite-element orbits and lets the twin find it over HTTP.

``python -m benchmarks.demo_seeds [--seeds N]`` runs the real command, service process included, and writes
``benchmarks/tables/demo_seeds.md``.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.markdown import markdown_table, save_table


def run_seed(seed: int) -> tuple[list[str], bool, bool]:
    """Run one demonstration.

    Returns
    -------
    row of the table, whether the effect was named or listed, whether the held-out error fell
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [Path(sys.executable).with_name("twin"), "demo", "--effect", "random", "--seed", str(seed)]
        begun = time.perf_counter()
        done = subprocess.run([*command, "--out", folder, "--json"], capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - begun
        if not done.stdout.strip():
            return [str(seed), "failed", done.stderr.strip(), "", "", "", f"{seconds:.0f}"], False, False
        outcome = json.loads(done.stdout)
    hidden = f"{outcome['hidden']['effect']} ({_place(outcome['hidden']['where'])})"
    found = "; ".join(f"{f['effect']} ({_place(f['where'])})" for f in outcome["report"]["findings"]) or "none"
    before, after = outcome["before_rmse_K"], outcome["after_rmse_K"]
    row = [str(seed), hidden, found, outcome["found"], f"{before:.3f}", f"{after:.3f}", f"{seconds:.0f}"]
    return row, outcome["found"] in ("named", "alternative"), after < before


def _place(where: dict[str, object]) -> str:
    return ", ".join("-".join(v) if isinstance(v, list) else str(v) for v in where.values())


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="how many seeds, from 0")
    n_seeds = parser.parse_args().seeds
    outcomes = []
    for seed in range(n_seeds):
        outcomes.append(run_seed(seed))
        print(" | ".join(outcomes[-1][0]), flush=True)
    header = ["seed", "hidden by the simulator", "found by the twin", "match", "before, K", "after, K", "seconds"]
    found, fell = sum(o[1] for o in outcomes), sum(o[2] for o in outcomes)
    note = f"Named, or listed among the stated alternatives: {found} of {n_seeds}. Held-out error fell: {fell} of {n_seeds}."
    save_table(
        "demo_seeds",
        "twin demo --effect random",
        markdown_table(header, [o[0] for o in outcomes]),
        "benchmarks.demo_seeds",
        note,
    )
    print(note)


if __name__ == "__main__":
    main()
