"""Mistakes in units and signs, made one at a time on a small satellite: each is told, and nothing else."""

from typing import Any

import numpy as np
import pytest

from twin_core.network.doubts import doubts
from twin_core.network.screened import all_screened, screened
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record


def declared(**changes: str) -> TwinSpec:
    units = {"T_a": "degC", "T_b": "K"} | changes
    data: dict[str, Any] = {
        "twin": "small",
        "boundaries": {"space": {"value_K": 2.7}},
        "channels": {name: {"kind": "temperature", "unit": unit} for name, unit in units.items()}
        | {"Q": {"kind": "power", "unit": "W"}},
        "nodes": [
            {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 400.0}},
            {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"guess": 300.0}},
        ],
        "conductors": [{"between": ["a", "b"]}],
        "radiators": [{"node": "b", "emissivity": 0.8, "area_m2": 0.02, "sink": "space"}],
        "loads": [{"channel": "Q", "node": "a"}],
    }
    return load_spec(data)


def telemetry(**scales: float) -> Record:
    """Return a closed form: a heater of 5 W on for every other half hour, each node lagging it by its time constant."""
    at = np.arange(400.0)
    heater = np.where(at // 30 % 2 == 0, 5.0, 0.0)
    swing = 3.0 * np.sin(2.0 * np.pi * (at - 8.0) / 60.0)
    values = {"T_a": 288.0 + swing, "T_b": 283.0 + 0.7 * swing, "Q": heater * scales.get("Q", 1.0)}
    return Record(60.0 * at, values | {n: values[n] + s for n, s in scales.items() if n != "Q"})


def test_a_sound_declaration_raises_no_doubt() -> None:
    assert doubts(declared(), [telemetry()]) == ()
    assert screened(declared(), telemetry()).notices == ()


@pytest.mark.parametrize(
    ("record", "told"),
    [
        (telemetry(T_b=-273.15), "channel 'T_b' is declared in K and reads 10.07 in the median: if that is degC"),
        (telemetry(T_a=273.15), "channel 'T_a' is declared in degC and reads 288.3 in the median: if that is K"),
        (telemetry(Q=1000.0), "if it reads mW, convert it to W"),
        (telemetry(Q=-1.0), "channel 'Q' is a power that is never positive (-5 to 0 W): check its sign"),
    ],
)
def test_one_mistake_is_told(record: Record, told: str) -> None:
    (said,) = doubts(declared(), [record])
    assert told in said
    assert said in screened(declared(), record).notices


def test_segments_are_judged_together_and_told_once() -> None:
    """By night the channel of the Sun shows an offset below zero only: no sign is wrong."""
    night = telemetry(Q=-0.001)
    assert all(record.notices == () for record in all_screened(declared(), [night, telemetry()]))
    told = [record.notices for record in all_screened(declared(), [night, night])]
    assert ["check its sign" in notice for notice in told[0]] == [True] and told[1] == ()


def test_an_isolated_node_is_told() -> None:
    data = declared().model_dump(exclude_none=True)
    data["nodes"] = [*data["nodes"], {"id": "lost", "capacity_J_per_K": {"guess": 5.0}}]
    (said,) = doubts(load_spec(data), [telemetry()])
    assert said.startswith("node 'lost' has no coupling and no load")


def test_a_power_that_no_load_reads_is_told() -> None:
    data = declared().model_dump(exclude_none=True)
    data["channels"]["P_spare"] = {"kind": "power", "unit": "W"}
    (said,) = doubts(load_spec(data), [telemetry()])
    assert said.startswith("no load reads the power 'P_spare'")


def test_inputs_are_screened_in_excluded_intervals_too() -> None:
    data = declared().model_dump(exclude_none=True) | {"exclude": [{"start": 6000.0, "stop": 9000.0, "reason": "test"}]}
    record = telemetry()
    record.values["T_a"][120], record.values["Q"][130] = 0.0, -9999.0
    clean = screened(load_spec(data), record)
    assert clean.values["T_a"][120] == 0.0 and np.isnan(clean.values["Q"][130])
    assert [(flaw.channel, flaw.reason) for flaw in clean.flaws or ()] == [("Q", "sentinel")]
