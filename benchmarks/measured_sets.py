"""The closed loop on measured telemetry: rigs and a spacecraft, each with a part held out that no choice has seen.

``python -m benchmarks.measured_sets [--data DIR]`` writes ``benchmarks/tables/measured_sets.md``. The data are not part of the
repository: sets that are absent are left out with a reason.
"""

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.markdown import markdown_table, save_table
from twin_core.discover import ClosedLoop, close_loop
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record
from twin_core.telemetry_csv import read_csv

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("MEASURED_DATA", ROOT.parent / "shared" / "data"))


@dataclass(frozen=True)
class MeasuredSet:
    """One split of one measured set.

    Attributes
    ----------
    name
        For the table.
    folder
        Its folder among the measured data.
    run
        Closes the loop on it.
    reference
        Error of somebody else's model on the same hold-out, in words.
    """

    name: str
    folder: str
    run: Callable[[Path], ClosedLoop]
    reference: Callable[[Path], str]


def _spec(name: str) -> TwinSpec:
    return load_spec(ROOT / "examples" / f"{name}.yaml")


def three_block(folder: Path) -> ClosedLoop:
    """Train on the first two hours, predict the following 22."""
    spec = _spec("three-block")
    return close_loop(spec, [read_csv(folder / "three_block_24h.csv", spec)], holdout=22 / 24)


def with_room(path: Path, spec: TwinSpec) -> Record:
    """Return a run of the temperature lab with the room's temperature from its first ten readings."""
    bare = spec.model_copy(update={"boundaries": {}})
    record = read_csv(path, spec, required=[c for c in spec.used_channels if c != "T_room_degC"])
    first = np.concatenate([record.values[sensor][:10] for sensor in bare.sensors])
    values = {**record.values, "T_room_degC": np.full(record.time_s.size, float(np.nanmean(first)))}
    return Record(record.time_s, values, record.epoch_ns, record.name)


def tclab(folder: Path) -> ClosedLoop:
    """Train on one sine and one step run, predict another step run of the same session."""
    spec = _spec("tclab")
    runs = {n: with_room(folder / f"{n}.csv", spec) for n in ("sine300s_run1", "step50_run1", "step50_run2")}
    return close_loop(
        spec,
        [runs["sine300s_run1"], runs["step50_run1"]],
        holdout_records=[runs["step50_run2"]],
        burn_in_s=30.0,
    )


def daisy(share: float) -> Callable[[Path], ClosedLoop]:
    """Return a loop that keeps the last ``share`` of the record back."""

    def run(folder: Path) -> ClosedLoop:
        spec = _spec("daisy")
        return close_loop(spec, [read_csv(folder / "daisy_heating_system.csv", spec)], holdout=share)

    return run


def chandra(folder: Path) -> ClosedLoop:
    """Train on 48 days of flight, predict 25 days five months later."""
    spec = _spec("chandra-psmc")
    flights = [read_csv(folder / f"flight_{part}.csv", spec) for part in "ab"]
    return close_loop(spec, flights[:1], holdout_records=flights[1:])


def flight_model(folder: Path) -> str:
    """Return the error of the flight operations model on the hold-out's rows."""
    measured = pd.read_csv(folder / "flight_b.csv")["T_psmc_degC"]
    predicted = pd.read_csv(folder / "flight_b_flight_model.csv")["T_psmc_degC"]
    return f"flight model {float(np.sqrt(np.mean((measured - predicted) ** 2))):.2f}"


def _published(words: str) -> Callable[[Path], str]:
    return lambda folder: words


SETS = (
    MeasuredSet("three blocks: 2 h, then 22 h", "three_block_tue", three_block, _published("linear fit 0.20 to 0.71")),
    MeasuredSet("temperature lab: same session", "tclab_notre_dame", tclab, _published("linear fit 0.68")),
    MeasuredSet("halogen lamp: 800 s, then 800 s", "daisy_heating", daisy(0.5), _published("linear fit 7.19")),
    MeasuredSet("halogen lamp: 1200 s, then 400 s", "daisy_heating", daisy(0.25), _published("linear fit 8.91")),
    MeasuredSet("Chandra power supply: flight a, then b", "chandra_psmc", chandra, flight_model),
)


def _words(loop: ClosedLoop) -> str:
    """Return what was found, with what the data cannot tell it from."""
    found = []
    for row in loop.report["findings"]:
        place = ", ".join(str(v) for v in row["where"].values())
        others = sorted({a["effect"] for a in row["alternatives"]})
        found.append(f"{row['effect']} ({place})" + (f", or {', '.join(others)}" if others else ""))
    return "; ".join(found) or "none"


def measure(data: Path) -> str:
    """Close the loop on every set that is there; return the table as markdown."""
    rows = []
    for item in SETS:
        folder = data / item.folder
        if not folder.is_dir():
            print(f"{item.name}: left out, its data are not here")
            continue
        loop = item.run(folder)
        report = loop.report
        rows.append(
            [
                item.name,
                report["verdict"],
                _words(loop),
                f"{report['before']['rmse_K']:.3f}",
                f"{report['after']['rmse_K']:.3f}",
                item.reference(folder),
                f"{report['elapsed_s']:.0f}",
            ]
        )
        print(" | ".join(rows[-1]), flush=True)
    header = ["set", "verdict", "found", "before, K", "after, K", "others, K", "seconds"]
    return markdown_table(header, rows)


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the measured sets")
    table = measure(parser.parse_args().data)
    save_table("measured_sets", "Closed loop on measured telemetry, held-out rmse", table, "benchmarks.measured_sets")


if __name__ == "__main__":
    main()
