"""The bands of every effect at its known place: what the estimator does, without what a search does to it.

``python -m benchmarks.band_study [--groups network fem fem2] [--seeds N] [--effects NAME ...] [--processes 2] [--results FILE]``
fits the right effect to seeded cases, appends one line of JSON per case to FILE (cases already in it are not run again), and
saves ``benchmarks/tables/bands.md``: the bands as a closed loop states them, and as the noise alone has them.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bands import Band, bands
from benchmarks.fem_cases import FEM_EFFECTS
from benchmarks.hidden_effects import HIDDEN
from benchmarks.loop import known_effect_trial, run_all
from benchmarks.loop_cases import Task
from benchmarks.markdown import markdown_table, save_table
from benchmarks.worlds.hidden import EFFECTS as NAMED
from twin_core.calibrate.discrepancy import stated
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.summary import to_model
from twin_core.closed_loop import centred
from twin_core.report.build import parameters_json

FIRST_SEED = 3000
"""Seeds from here on belong to the study; the suite uses smaller ones."""
SEEDS_PER_EFFECT = 50
RESULTS = Path("build/bands.jsonl")
EFFECTS = {"network": tuple(HIDDEN), "fem": FEM_EFFECTS, "fem2": tuple(NAMED)}


def run(task: Task) -> dict[str, Any]:
    """Fit one case; return its bands."""
    case = task.build()
    begun = time.perf_counter()
    trial = known_effect_trial(case)
    row = {"task": task.name, "group": task.group, "effect": case.effect}
    if trial is None:
        return row | {"bands": [], "seconds": time.perf_counter() - begun}
    plain = centred(to_model(trial.calibration(), trial.present_effects), trial.fit)
    discrepancy = trial.discrepancy()
    wide = plain if discrepancy is None else stated(plain, discrepancy)

    def held(model: CalibratedModel) -> list[tuple[str, float, float, float]]:
        found = parameters_json(model.effects[0], {p["name"]: p["std"] for p in model.summary["parameters"]})
        return [(b.name, b.mean, b.std, b.true) for b in bands(case.parameters, found)]

    return row | {
        "bands": held(wide),
        "by_noise": held(plain),
        "rms_share": _rms(np.concatenate(trial.calibration().residuals) / trial.calibration().problem.noise_K),
        "seconds": time.perf_counter() - begun,
    }


def told(row: dict[str, Any]) -> str:
    """Return a row in one line."""
    held = [Band(*band) for band in row["bands"]]
    words = (f"{b.name} {b.mean:.5g} ± {b.std:.2g} (true {b.true:.5g}, z {b.z:+.2f})" for b in held)
    return f"{row['task']}: {'; '.join(words)} | residual over noise {row.get('rms_share', np.nan):.2f}"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return one line per group and effect, and one per group."""
    lines = []
    for group in dict.fromkeys(row["group"] for row in rows):
        own = [row for row in rows if row["group"] == group]
        named = [(e, [row for row in own if row["effect"] == e]) for e in dict.fromkeys(row["effect"] for row in own)]
        for effect, some in [*named, ("all", own)]:
            held, by_noise = ([Band(*b) for row in some for b in row.get(key, ())] for key in ("bands", "by_noise"))
            lines.append([group, effect, str(len(some)), str(len(held)), *_coverage(held), *_coverage(by_noise)])
    head = ["in the 90 % band", "z, rms", "by the noise alone", "z, rms"]
    return markdown_table(["truth", "effect", "cases", "parameters", *head], lines)


def _coverage(held: Sequence[Band]) -> tuple[str, str]:
    """Return the share of bands that hold the truth, and how many deviations it is off, rms."""
    if not held:
        return "none", "nan"
    return f"{100 * np.mean([b.holds for b in held]):.0f} %", f"{_rms(np.array([b.z for b in held])):.2f}"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", nargs="+", default=list(EFFECTS), choices=EFFECTS)
    parser.add_argument("--seeds", type=int, default=3, help="cases per effect")
    parser.add_argument("--effects", nargs="+", help="only these effects")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    tasks = [
        Task(group, effect, FIRST_SEED + SEEDS_PER_EFFECT * i + k)
        for group in arguments.groups
        for k in range(arguments.seeds)
        for i, effect in enumerate(EFFECTS[group])
        if not arguments.effects or effect in arguments.effects
    ]
    rows = run_all(tasks, arguments.results, arguments.processes, run, told)
    failed = [row for row in rows if "error" in row]
    note = "\n".join(f"Failed: {row['task']}: {row['error']}" for row in failed)
    save_table(
        "bands",
        "Bands of effects at their known place",
        table([r for r in rows if "error" not in r]),
        "benchmarks.band_study",
        note,
    )


if __name__ == "__main__":
    main()
