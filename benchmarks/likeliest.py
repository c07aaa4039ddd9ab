"""How far below its maximum is the likelihood of trajectories where least squares end, and in how many steps is it there?

``python -m benchmarks.likeliest [--first-seed N]`` fits spacecraft of the second finite-element world, as declared and with the
steady effect that is hidden in each at its place, lets the likelihood climb in none, half, all and twice the steps at most, and
saves ``benchmarks/tables/likeliest.md``. Off, evidence is that of least squares.
"""

import argparse
from dataclasses import replace

from benchmarks.case import TRAINING_SHARE
from benchmarks.loop_cases import Task
from benchmarks.markdown import markdown_table, save_table
from twin_core.calibrate import likeliest
from twin_core.calibrate.gradients import with_gradients
from twin_core.calibrate.second_order import Calibration, fit_network
from twin_core.discover.trial import Trial, try_on_trajectories
from twin_core.effects import REGISTRY
from twin_core.holdout import split_fraction

FIRST_SEED = 113_000
EFFECTS = {
    "radiation_to_sink": 0,
    "radiative_exchange": 10,
    "missing_conductor": 20,
    "leak_to_boundary": 30,
    "constant_heat_load": 50,
    "input_gain": 100,
}
"""Effects without a setting that a local search could miss, and which case of a draw hides each."""

STEPS = {
    "off": 0,
    "half": likeliest.MOST_STEPS // 2,
    "as it is": likeliest.MOST_STEPS,
    "double": 2 * likeliest.MOST_STEPS,
}


def climbed(calibration: Calibration) -> list[tuple[float, float]]:
    """Return the log posterior along plain trajectories and beside gradients for every number of steps, in nats."""
    found = []
    for likeliest.MOST_STEPS in STEPS.values():  # type: ignore[misc]
        beside = with_gradients(calibration.problem, calibration.optimum)
        assert beside is not None
        found.append((replace(calibration).log_posterior, beside.log_posterior))
    return found


def rows_of(name: str, seed: int) -> list[list[str]]:
    """Return the rows of one case: without the effect, and with it."""
    case = Task("fem2", name, seed).build()
    records = split_fraction([case.record], 1.0 - TRAINING_SHARE)[0]
    fit, declared = fit_network(case.spec, records)
    base = Trial((), fit, declared.max_step_s, (declared.optimum,))
    right = try_on_trajectories(base, (REGISTRY[name](case.where, dict(case.parameters)),))
    assert right is not None
    rows = []
    for model, calibration in (("declared", declared), ("with it", right.calibration())):
        found = climbed(calibration)
        gains = [f"{plain - found[0][0]:.0f} · {beside - found[0][1]:.0f}" for plain, beside in found[1:]]
        rows.append([f"{name} {seed}", model, *gains])
    return rows


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    given = parser.parse_args()
    rows = [row for name, offset in EFFECTS.items() for row in rows_of(name, given.first_seed + offset)]
    save_table(
        "likeliest",
        "How far least squares lie below the greatest likelihood",
        markdown_table(["hidden", "model", *list(STEPS)[1:]], rows),
        "benchmarks.likeliest",
        "Nats gained over least squares, along plain trajectories · beside gradients within the nodes, by the number of steps at"
        f" most ({', '.join(f'{name} {n}' for name, n in STEPS.items())}).",
    )


if __name__ == "__main__":
    main()
