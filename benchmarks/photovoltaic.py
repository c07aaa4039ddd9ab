"""Photovoltaic arrays in the field: modules and inverters under clouds, wind, night skies and snow, as splits of a benchmark.

The folder is ``pvanalytics/data`` of the package of that name: ``pip download --no-deps pvanalytics==0.2.2``, then unzip the
wheel. Readings are quarter-hourly, longer than a module takes to settle; what wind and a clear sky take away is not declared,
and in each record snow falls on a part of what is held out.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.measured_splits import Prepared, Split, published
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

HELD_OUT = (0.2, 0.3, 0.4, 0.5)

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
