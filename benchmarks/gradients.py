"""How much of the misfit of a coarse network do temperature gradients within its nodes explain, of how large a Biot number?

``python -m benchmarks.gradients [--first-seed N]`` fits the declared network of spacecraft of the second finite-element world,
healthy ones and one for every hidden effect, with and without gradients, for their standard deviation off (none), at half and at
double, and saves ``benchmarks/tables/gradients.md``. What they explain no effect has to; so much must not be what effects do.
"""

import argparse
from collections.abc import Sequence

import numpy as np

from benchmarks.case import TRAINING_SHARE
from benchmarks.loop_cases import Task, suite
from benchmarks.markdown import markdown_table, save_table
from twin_core.calibrate import gradients
from twin_core.calibrate.second_order import fit_network
from twin_core.discover.trial import Trial
from twin_core.holdout import split_fraction

FIRST_SEED = 85_000
NONE = 1e-9
SETTINGS = {"none": NONE, "half": 0.5 * gradients.BIOT, "as it is": gradients.BIOT, "double": 2.0 * gradients.BIOT}


def left_beside(task: Task) -> list[float]:
    """Return the variance that the declared network leaves of the training part, in units of the noise, for every setting.

    A setting under which the readings are less likely than without gradients leaves what stays without.
    """
    case = task.build()
    records = split_fraction([case.record], 1.0 - TRAINING_SHARE)[0]
    fit, calibration = fit_network(case.spec, records)
    found = []
    for gradients.BIOT in SETTINGS.values():  # type: ignore[misc]
        trial = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
        found.append(trial.unexplained())
    return found


def row(name: str, left: Sequence[Sequence[float]]) -> list[str]:
    """Return the row of one group: its size, and per setting median and largest of what stays."""
    table = np.array(left)
    return [
        name,
        str(len(table)),
        *(f"{np.median(column):.2f} ({column.min():.2f} to {column.max():.2f})" for column in table.T),
    ]


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    given = parser.parse_args()
    rows = []
    for group, name in (("clean_fem2", "healthy"), ("fem2", "one effect hidden")):
        tasks = suite((group,), n_networks=1, first_seed=given.first_seed)
        rows.append(row(name, [left_beside(task) for task in tasks]))
    save_table(
        "gradients",
        "What gradients within the nodes explain",
        markdown_table(["second finite-element world", "n", *SETTINGS], rows),
        "benchmarks.gradients",
        "Variance beyond the sensors' noise that the declared network leaves of the training part, in units of that noise: median"
        " over the spacecraft, smallest and largest, by the standard deviation of the gradients' Biot number.",
    )


if __name__ == "__main__":
    main()
