"""At how many instants would no event be named, because an input changes there as nowhere else?

``python -m benchmarks.lone_changes [--data DIR] [--first-seed N]`` counts them over the training part of seeded spacecraft and
of the measured sets, for the threshold and for the stretch that counts as one moment off, at half and at double, and saves
``benchmarks/tables/lone_changes.md``. So likely is it that an event is refused which has nothing to do with the inputs.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.case import TRAINING_SHARE
from benchmarks.loop_cases import suite
from benchmarks.markdown import markdown_table, save_table
from benchmarks.measured_splits import DATA, SPLITS
from twin_core.discover import coincidence, policy
from twin_core.holdout import split_fraction
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record

FIRST_SEED = 9000
Training = tuple[str, TwinSpec, Sequence[Record]]


def seeded(first_seed: int) -> list[Training]:
    """Return the training parts of seeded spacecraft: every hidden effect once, and healthy ones."""
    cases = [(t.group, t.build()) for t in suite(("network", "clean"), n_networks=1, n_clean=20, first_seed=first_seed)]
    return [("seeded spacecraft", c.spec, split_fraction([c.record], 1.0 - TRAINING_SHARE)[0]) for _, c in cases]


def measured(data: Path) -> list[Training]:
    """Return the training parts of the measured sets that are there."""
    there = [(split, split.prepare(data / split.folder)) for split in SPLITS if (data / split.folder).is_dir()]
    return [
        (split.name.split(":")[0], p.spec, p.records if p.held_out else split_fraction(p.records, p.holdout or 0.3)[0])
        for split, p in there
    ]


def refused_share(spec: TwinSpec, records: Sequence[Record]) -> float:
    """Return the share of all samples at which an event would coincide with a lone change of an input."""
    alone = [np.zeros(record.time_s.size, dtype=bool) for record in records]
    for name in (name for name in spec.channels if name not in spec.sensors):
        for own, found in zip(alone, coincidence.lone_changes(records, name), strict=True):
            own |= found
    return float(np.concatenate(alone).mean())


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    given = parser.parse_args()
    every = [*seeded(given.first_seed), *measured(given.data)]
    about, n_beside = policy.THRESHOLDS["LONE_CHANGE"], coincidence.N_BESIDE
    settings = {
        "as it is": (policy.LONE_CHANGE, n_beside),
        "threshold off": (about.off, n_beside),
        "half": (about.half, n_beside),
        "double": (about.double, n_beside),
        "moment half": (policy.LONE_CHANGE, n_beside // 2),
        "moment double": (policy.LONE_CHANGE, 2 * n_beside),
    }
    shares: dict[str, list[list[float]]] = {}
    for name, spec, records in every:
        row = []
        for policy.LONE_CHANGE, coincidence.N_BESIDE in settings.values():  # type: ignore[misc]
            row.append(refused_share(spec, records))
        shares.setdefault(name, []).append(row)
    rows = [
        [name, str(len(table)), *(f"{100.0 * share:.1f} %" for share in np.mean(table, axis=0))]
        for name, table in shares.items()
    ]
    note = "Mean over the records of the share of their samples at which an input has a lone change."
    save_table(
        "lone_changes",
        "Where no event would be named",
        markdown_table(["records", "n", *settings], rows),
        "benchmarks.lone_changes",
        note,
    )


if __name__ == "__main__":
    main()
