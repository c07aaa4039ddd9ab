"""Measured sets and how each is split: what an operator would declare, what is trained on, what is predicted.

The data are not part of the repository: they lie in the folder that the environment variable MEASURED_DATA names, by default
``shared/data`` beside the checkout.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record
from twin_core.telemetry_csv import read_csv

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("MEASURED_DATA", ROOT.parent / "shared" / "data"))


@dataclass(frozen=True)
class Prepared:
    """What a closed loop is given.

    Attributes
    ----------
    spec, records
        The declaration, and the telemetry to train on.
    holdout
        Share of the span of ``records`` that is kept back at the end; unused where ``held_out`` is given.
    held_out
        Telemetry of its own that is predicted.
    burn_in_s
        First seconds of each of these that tell its initial state and are not scored.
    """

    spec: TwinSpec
    records: Sequence[Record]
    holdout: float | None = None
    held_out: Sequence[Record] = ()
    burn_in_s: float | None = None


@dataclass(frozen=True)
class Split:
    """One split of one measured set.

    Attributes
    ----------
    name
        For the table.
    folder
        Its folder among the measured data.
    prepare
        Reads the telemetry in that folder.
    reference
        What others reach on the same hold-out, in words.
    scored
        Sensors whose own held-out error is told beside that of all; empty for none.
    every_pair
        Whether each record of the hold-out is also scored on its own: an ordered pair of runs.
    """

    name: str
    folder: str
    prepare: Callable[[Path], Prepared]
    reference: Callable[[Path], str]
    scored: tuple[str, ...] = ()
    every_pair: bool = False


def example(name: str) -> TwinSpec:
    """Return a specification of the examples."""
    return load_spec(ROOT / "examples" / f"{name}.yaml")


def last_part(declaration: str, file: str, share: float) -> Callable[[Path], Prepared]:
    """Return what reads one file and keeps the last ``share`` of it back."""

    def prepare(folder: Path) -> Prepared:
        spec = example(declaration)
        return Prepared(spec, [read_csv(folder / file, spec)], holdout=share)

    return prepare


def chandra(folder: Path) -> Prepared:
    """Train on 48 days of flight, predict 25 days five months later."""
    spec = example("chandra-psmc")
    flights = [read_csv(folder / f"flight_{part}.csv", spec) for part in "ab"]
    return Prepared(spec, flights[:1], held_out=flights[1:])


def flight_model(folder: Path) -> str:
    """Return the error of the flight operations model on the hold-out's rows."""
    measured = pd.read_csv(folder / "flight_b.csv")["T_psmc_degC"]
    predicted = pd.read_csv(folder / "flight_b_flight_model.csv")["T_psmc_degC"]
    return f"flight model {float(np.sqrt(np.mean((measured - predicted) ** 2))):.2f}"


FIRST_SESSION = (*(f"sine300s_run{i}" for i in (1, 2, 3, 4)), "step50_run1", "step50_run2")
SECOND_SESSION = (*(f"sine{p}s_run{i}" for p in (120, 50) for i in (1, 2, 3)), "step50_run3")
"""The temperature lab's device changed between these two (its README): ten per cent less gain, a fifth more loss."""
RUNS = tuple(sorted((*FIRST_SESSION, *SECOND_SESSION)))


def with_room(path: Path, spec: TwinSpec) -> Record:
    """Return a run of the temperature lab with the room's temperature from its first ten readings."""
    bare = spec.model_copy(update={"boundaries": {}})
    record = read_csv(path, spec, required=[c for c in spec.used_channels if c != "T_room_degC"])
    first = np.concatenate([record.values[sensor][:10] for sensor in bare.sensors])
    values = {**record.values, "T_room_degC": np.full(record.time_s.size, float(np.nanmean(first)))}
    return Record(record.time_s, values, record.epoch_ns, path.stem)


def temperature_lab(train: Iterable[str], predict: Iterable[str], folder: Path) -> Prepared:
    """Train on some runs of the temperature lab, predict others."""
    spec = example("tclab")
    train, predict = ([with_room(folder / f"{run}.csv", spec) for run in runs] for runs in (train, predict))
    return Prepared(spec, train, held_out=predict, burn_in_s=30.0)


def published(words: str) -> Callable[[Path], str]:
    """Return a reference that is told in words; it can be sent between processes."""
    return partial(_told, words)


def _told(words: str, folder: Path) -> str:
    return words


def _lab(name: str, train: Sequence[str], predict: Sequence[str], others: str, every_pair: bool = False) -> Split:
    prepare = partial(temperature_lab, train, predict)
    return Split(f"temperature lab: {name}", "tclab_notre_dame", prepare, published(others), (), every_pair=every_pair)


def _blocks(declaration: str, words: str, train_h: int, others: str) -> Split:
    name = f"three blocks{words}: {train_h} h, then {24 - train_h} h"
    prepare = last_part(declaration, "three_block_24h.csv", 1.0 - train_h / 24)
    return Split(name, "three_block_tue", prepare, published(others))


def _without(*runs: str, among: Sequence[str] = RUNS) -> tuple[str, ...]:
    return tuple(run for run in among if run not in runs)


PANELS = tuple(f"T_solar_{face}_degC" for face in ("px", "mx", "py", "my"))
HOMES = {1: ("TiTeTh", 3), 2: ("TiTmTh", 3), 3: ("TiTmTeTs", 4)}
"""The structures that the owners of the data chose for each home, and how many states they have."""

SPLITS = (
    _blocks("three-block", "", 2, "linear fit 0.20 to 0.71"),
    _blocks("three-block", "", 12, "fit to all 24 h: 0.12 to 0.16"),
    _blocks("three-block-film", ", one film coefficient", 2, "linear fit 0.71"),
    _blocks("three-block-film", ", one film coefficient", 12, "fit to all 24 h: 0.16"),
    _lab("same session", ("sine300s_run1", "step50_run1"), ("step50_run2",), "linear fit 0.68, sensor mass 0.28"),
    _lab(
        "two sines, then two steps and a sine",
        ("sine300s_run1", "sine300s_run2"),
        ("step50_run1", "step50_run2", "sine300s_run3"),
        "linear fit 1.31, sensor mass 0.85",
    ),
    _lab(
        "a fast and a very fast sine, then four such",
        ("sine120s_run2", "sine50s_run2"),
        ("sine120s_run1", "sine120s_run3", "sine50s_run1", "sine50s_run3"),
        "linear fit 1.34, sensor mass 0.55",
    ),
    _lab(
        "a sine and a step, then all 11 others",
        ("sine300s_run1", "step50_run1"),
        _without("sine300s_run1", "step50_run1"),
        "linear fit 2.95, sensor mass 2.59",
    ),
    _lab("first session, then second", FIRST_SESSION, SECOND_SESSION, "none"),
    _lab("second session, then first", SECOND_SESSION, FIRST_SESSION, "none"),
    *(_lab(f"{run}, then each other run", (run,), _without(run), "none", every_pair=True) for run in RUNS),
    *(
        Split(
            f"halogen lamp: {1600 * (1 - share):.0f} s, then {1600 * share:.0f} s",
            "daisy_heating",
            last_part("daisy", "daisy_heating_system.csv", share),
            published(others),
        )
        for share, others in (
            (0.5, "linear fit 7.19, two nodes with T⁴ 2.94"),
            (0.25, "linear fit 8.91, two nodes 2.61"),
        )
    ),
    Split("Chandra power supply: flight a, then b", "chandra_psmc", chandra, flight_model),
    Split(
        "FUNcube-1: 60 %, then 40 %",
        "funcube1",
        last_part("funcube1", "whole_orbit_2016-02-04.csv", 0.4),
        published("two nodes, one panel 1.9 to 2.2"),
        scored=PANELS,
    ),
    *(
        Split(
            f"FlexHouse, {words}: 60 %, then 40 %",
            "flexhouse_prbs",
            last_part(declaration, "prbs_2009.csv", 0.4),
            published("one state 1.21, two states 0.73"),
        )
        for declaration, words in (("flexhouse-one-node", "one node"), ("flexhouse", "room and envelope"))
    ),
    *(
        Split(
            f"Dutch home {i}: 70 %, then 30 %",
            "dutch_homes",
            last_part("dutch-home", f"home_{i}.csv", 0.3),
            published(f"{structure}, {states} states; no open loop"),
        )
        for i, (structure, states) in HOMES.items()
    ),
)

ONE_OF_EACH = (
    "halogen lamp: 800 s, then 800 s",
    "Chandra power supply: flight a, then b",
    "FUNcube-1: 60 %, then 40 %",
    "FlexHouse, one node: 60 %, then 40 %",
    "FlexHouse, room and envelope: 60 %, then 40 %",
    "Dutch home 1: 70 %, then 30 %",
    "Dutch home 2: 70 %, then 30 %",
    "Dutch home 3: 70 %, then 30 %",
)
"""A split of every set but the blocks and the lab, of which others may be wanted."""
