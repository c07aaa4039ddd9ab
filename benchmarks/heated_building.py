"""A heated building over five weeks with a holiday, as splits of a benchmark: hourly, with more heats than the heating's.

The folder is ``docs/tutorials/data`` of darkgreybox, which its source distribution holds: ``pip download --no-deps --no-binary
:all: darkgreybox==0.3.2``, then untar it. Its authors call the data far from ideal: sun, people and hot water are not metered,
and the heating is shut down over the holiday. They hold out the last five days. A power is told in kW, a heater's medium in degC.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.measured_splits import Prepared, Split, published
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

FILE = "demo_data.csv"
HELD_OUT = {"five days": 5.0 / 33.0, "30%": 0.3, "45%": 0.45}
DEGREES = {"kind": "temperature", "unit": "degC"}

INDOORS: dict[str, Any] = {
    "twin": "building",
    "boundaries": {"outdoors": {"channel": "Ta"}},
    "channels": {"Ti": DEGREES, "Ta": DEGREES, "Ph": {"kind": "power", "unit": "W"}},
    "nodes": [{"id": "indoors", "sensor": "Ti", "capacity_J_per_K": {"guess": 1.0e8}}],
    "conductors": [{"between": ["indoors", "outdoors"], "conductance_W_per_K": {"guess": 1000.0}}],
    "loads": [{"channel": "Ph", "node": "indoors"}],
}
ENVELOPE: dict[str, Any] = INDOORS | {
    "nodes": [*INDOORS["nodes"], {"id": "envelope", "capacity_J_per_K": {"guess": 5.0e8}}],
    "conductors": [
        {"between": ["indoors", "envelope"], "conductance_W_per_K": {"guess": 3000.0}},
        {"between": ["envelope", "outdoors"], "conductance_W_per_K": {"guess": 1500.0}},
    ],
}
HEATER = {"between": ["indoors", "heater"], "conductance_W_per_K": {"guess": 500.0}}


def heated_through(declared: dict[str, Any]) -> dict[str, Any]:
    """Return a declaration with a node for the heater, whose medium is measured, between the power and the rooms."""
    return declared | {
        "channels": declared["channels"] | {"Th": DEGREES},
        "nodes": [*declared["nodes"], {"id": "heater", "sensor": "Th", "capacity_J_per_K": {"guess": 2.0e6}}],
        "conductors": [*declared["conductors"], HEATER],
        "loads": [{"channel": "Ph", "node": "heater"}],
    }


DECLARATIONS: dict[str, dict[str, Any]] = {
    "indoors": INDOORS,
    "indoors, unknown gain and the hour": INDOORS
    | {
        "channels": INDOORS["channels"] | {"hour": {"kind": "auxiliary", "unit": "h"}},
        "loads": [{"channel": "Ph", "node": "indoors", "gain": {"guess": 1.0}}],
    },
    "indoors and envelope": ENVELOPE,
    "indoors, heated by its medium": INDOORS
    | {
        "boundaries": {"outdoors": {"channel": "Ta"}, "heater": {"channel": "Th"}},
        "channels": {"Ti": DEGREES, "Ta": DEGREES, "Th": DEGREES},
        "conductors": [*INDOORS["conductors"], HEATER],
        "loads": [],
    },
    "indoors and heater": heated_through(INDOORS),
    "indoors, envelope and heater": heated_through(ENVELOPE),
}
"""What is declared of the building, from the simplest on."""


def prepared(declaration: str, share: float, folder: Path) -> Prepared:
    """Return what the loop is given of a declaration."""
    declared = DECLARATIONS[declaration]
    table = pd.read_csv(folder / FILE, index_col=0, parse_dates=True)
    table.index = table.index.tz_localize(None)
    table["hour"] = table.index.hour
    instants = table.index.to_numpy().astype("datetime64[ns]").astype(np.int64)
    scales, offsets = {"P": 1000.0}, {"T": ZERO_CELSIUS_K}
    values = {
        name: scales.get(name[0], 1.0) * table[name].to_numpy(dtype=float) + offsets.get(name[0], 0.0)
        for name in declared["channels"]
    }
    record = Record((instants - instants[0]) / 1e9, values, int(instants[0]), "building")
    return Prepared(load_spec(declared), [record], holdout=share)


SPLITS = tuple(
    Split(f"building, {declaration}: {words} held out", ".", partial(prepared, declaration, share), published(""))
    for declaration in DECLARATIONS
    for words, share in HELD_OUT.items()
)
