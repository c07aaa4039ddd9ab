"""The orbit as an input, on flight data: eclipses that a CubeSat's solar cells saw, and its temperatures out of sight.

``python -m benchmarks.orbit_flight [--data DIR]`` writes ``benchmarks/tables/orbit_flight.md``. The data (FUNcube-1, a day of
2016) are not part of the repository. Rows that repeat the one before in every column are left out: the ground station held
the last value.
"""

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.markdown import markdown_table, save_table
from benchmarks.measured_splits import DATA, ROOT
from twin_core._typing import FloatArray
from twin_core.calibrate import CalibratedModel, calibrate
from twin_core.holdout import predict, split_fraction
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.orbit.environment import Environment
from twin_core.orbit.means import over_steps
from twin_core.telemetry_csv import read_csv

FILE = Path("funcube1") / "whole_orbit_2016-02-04.csv"
HOLDOUT = 0.4
LIT_MA = 30.0
"""Photo current above which the cells are in sunlight; it is 1 to 4 mA in the dark and some 280 mA in the light."""
BRACKET_S = 61.0
"""Rows further apart do not tell when the light changed."""


def live_rows(data: Path) -> pd.DataFrame:
    """Return the rows that were measured: no repeated row, no repeated instant."""
    table = pd.read_csv(data / FILE)
    columns = [name for name in table.columns if name != "time"]
    held = (table[columns] == table[columns].shift()).all(axis=1)
    return table[~held & ~table["time"].duplicated()].reset_index(drop=True)


@dataclass(frozen=True)
class Crossings:
    """Entries into and exits from the shadow that fell between two rows.

    ``off_s``: the middle between the two rows minus the computed instant; ``enters``: which are entries; (n_crossings,).
    """

    off_s: FloatArray
    enters: FloatArray


def crossings(rows: pd.DataFrame, environment: Environment) -> Crossings:
    """Return how far the light's changes in the telemetry lie from the computed ones."""
    instants = pd.to_datetime(rows["time"], utc=True).astype("datetime64[ns, UTC]").astype(np.int64).to_numpy()
    epoch_ns, time_s = int(instants[0]), (instants - instants[0]) / 1e9
    grid_s = np.arange(0.0, time_s[-1], 1.0)
    sunlit = environment.sky(epoch_ns, grid_s).sunlit > 0.5
    found = []
    lit = rows["I_photo_mA"].to_numpy() > LIT_MA
    for row in np.flatnonzero((lit[1:] != lit[:-1]) & (np.diff(time_s) <= BRACKET_S)):
        changes = grid_s[1:][(sunlit[1:] != sunlit[:-1]) & (sunlit[1:] == lit[row + 1])]
        middle_s = 0.5 * (time_s[row] + time_s[row + 1])
        found.append((middle_s - changes[np.argmin(np.abs(changes - middle_s))], lit[row]))
    off_s, enters = np.array(found, dtype=float).T
    return Crossings(off_s, enters)


def fit_and_predict(rows: pd.DataFrame, spec: TwinSpec) -> tuple[CalibratedModel, FloatArray]:
    """Calibrate on the first part of the rows; return the model and its open-loop errors on the rest, in K."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.csv"
        rows.to_csv(path, index=False)
        record = read_csv(path, spec)
    train, (held,) = split_fraction([record], HOLDOUT)
    model = calibrate(spec, train)
    done = predict(model, held)
    return model, done.measured_K - done.predicted_K


def rmse_K(errors: FloatArray) -> float:
    """Return the root mean square over all readings."""
    return float(np.sqrt(np.nanmean(errors**2)))


def _seconds_for(environment: Environment, n_samples: int) -> float:
    begun = time.process_time()
    over_steps(
        environment, 1_454_544_000_000_000_000, 60.0 * np.arange(n_samples), np.full(n_samples, 60.0), np.zeros(2)
    )
    return time.process_time() - begun


def _told_apart(model: CalibratedModel) -> list[list[str]]:
    """Return what black and silver coupons came out at, and by how many deviations they differ."""
    rows = {row["name"]: row for row in model.summary["parameters"]}
    found = []
    for place in ("chassis", "panel"):
        for words, name in (("sunlight gain, cm2", "gain:orbit.sun_mean|{}"), ("loss to space, mW/K", "G:{}|space")):
            black, silver = (rows[name.format(f"{colour}_{place}")] for colour in ("black", "silver"))
            scale = 1e4 if "cm2" in words else 1e3
            apart = (black["mean"] - silver["mean"]) / np.hypot(black["std"], silver["std"])
            pair = ", ".join(
                f"{c} {scale * r['mean']:.1f} ± {scale * r['std']:.1f}"
                for c, r in (("black", black), ("silver", silver))
            )
            found.append([f"coupons on the {place}: {words}", f"{pair} ({apart:.1f} deviations apart)"])
    return found


def measure(data: Path) -> str:
    """Return the table as markdown."""
    spec = load_spec(ROOT / "examples" / "funcube1.yaml")
    assert spec.orbit is not None
    rows, environment = live_rows(data), spec.orbit.environment()
    seen = crossings(rows, environment)
    model, errors = fit_and_predict(rows, spec)
    panels = [i for i, sensor in enumerate(spec.sensors) if "solar" in sensor]
    told = [f"{name.removesuffix('_degC')} {rmse_K(errors[:, [i]]):.2f}" for i, name in enumerate(spec.sensors)]
    by_way = [seen.off_s[seen.enters == way].mean() for way in (1.0, 0.0)]
    table = [
        ["crossings of the shadow's edge between rows a minute apart", f"{seen.off_s.size}"],
        ["telemetry minus computed: mean, deviation", f"{seen.off_s.mean():.0f} s, {seen.off_s.std():.0f} s"],
        ["the same: entries, exits", f"{by_way[0]:.0f} s, {by_way[1]:.0f} s"],
        ["held-out rmse of the solar panels, last 40 %, K", f"{rmse_K(errors[:, panels]):.2f}"],
        ["held-out rmse of all sensors, K", f"{rmse_K(errors):.2f}"],
        ["each, K", ", ".join(told)],
        *_told_apart(model),
        [
            "seconds of one core for the orbit over 100,000 samples, tumbling",
            f"{_seconds_for(environment, 100_000):.2f}",
        ],
    ]
    return markdown_table(["FUNcube-1", "measured"], table)


NOTE = (
    "A row a minute makes a deviation of 17 s by itself. Entries and exits share their offset: the clock of the telemetry,"
    " whose stamps are whole minutes, is early by it."
)


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the measured sets")
    table = measure(parser.parse_args().data)
    print(table)
    save_table("orbit_flight", "The orbit as an input, on flight data", table, "benchmarks.orbit_flight", NOTE)


if __name__ == "__main__":
    main()
