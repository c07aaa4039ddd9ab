"""Telemetry and networks at the edges: an answer in the report's form, or one clear line, never a crash."""

import copy
import json
from typing import Any

import numpy as np
import pytest

from tests.analytic import laplacian, linear_states
from tests.helpers import conductive_spec
from twin_core.closed_loop import close_loop
from twin_core.discover.judge import MISTAKE
from twin_core.effects import REGISTRY
from twin_core.errors import TelemetryError
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

N_TIMES = 120
POWER = {"kind": "power", "unit": "W"}
PAIR = conductive_spec(2, [(0, 1)], channels={"Q": POWER}, loads=[{"channel": "Q", "node": "n0"}])


def readings() -> dict[str, np.ndarray]:
    """Return two nodes of 4 and 7 kJ/K and 2.5 W/K between them, heated on and off."""
    rng = np.random.default_rng(0)
    heat = np.repeat(rng.choice([0.0, 40.0, 90.0], N_TIMES // 10), 10)
    capacity = np.array([4.0e3, 7.0e3])
    rates = -laplacian(2, [(0, 1)], [2.5]) / capacity[:, None]
    drive = np.outer(heat, [1.0 / capacity[0], 0.0])
    truth = linear_states(rates, drive, np.array([290.0, 288.0]), 60.0 * np.arange(N_TIMES))
    noisy = truth + rng.normal(0.0, 0.1, truth.shape)
    return {"Q": heat, "T0": noisy[:, 0], "T1": noisy[:, 1]}


def record(epoch_ns: int | None = None, **more: np.ndarray | float) -> Record:
    columns = {name: np.broadcast_to(np.asarray(x, dtype=float), (N_TIMES,)) for name, x in (readings() | more).items()}
    return Record(60.0 * np.arange(N_TIMES), columns, epoch_ns)


def edited(**fields: Any) -> dict[str, Any]:
    return copy.deepcopy(PAIR) | fields


def two_sensors() -> dict[str, Any]:
    data = edited()
    data["channels"]["T0b"] = {"kind": "temperature", "unit": "degC"}
    data["nodes"][0]["sensor"] = ["T0", "T0b"]
    return data


def auxiliary() -> dict[str, Any]:
    data = edited()
    data["channels"] |= {"aux": {"kind": "auxiliary"}, "mode": {"kind": "auxiliary", "levels": True}}
    return data


LATE = np.arange(N_TIMES) > 0.7 * N_TIMES
HEALTHY: dict[str, tuple[dict[str, Any], Record]] = {
    "no boundaries": (PAIR, record()),
    "dates": (PAIR, record(epoch_ns=1_700_000_000_000_000_000)),
    "two sensors on one node": (two_sensors(), record(T0b=readings()["T0"] + 0.01)),
    "auxiliary channels without samples": (auxiliary(), record(aux=np.nan)),
    "auxiliary channels that rest": (auxiliary(), record(aux=3.0, mode=1.0)),
    "a node apart that nobody reads": (edited(nodes=[*PAIR["nodes"], {"id": "apart"}]), record()),
    "whole kelvins": (PAIR, record(T0=np.round(readings()["T0"]), T1=np.round(readings()["T1"]))),
    "nothing happens": (PAIR, record(Q=0.0, T0=290.0, T1=290.0)),
    "a sensor that dies in the hold-out": (PAIR, record(T1=np.where(LATE, np.nan, readings()["T1"]))),
    "an excluded end": (edited(exclude=[{"start": 6000.0, "stop": 1e9}]), record()),
}


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_pair_stays_healthy(name: str) -> None:
    data, telemetry = HEALTHY[name]
    loop = close_loop(load_spec(data), [telemetry])
    assert loop.report["verdict"] == "no_effect_supported"
    for part in (loop.report, loop.plots, loop.model.to_json()):
        json.dumps(part, allow_nan=False)
    assert isinstance(loop.report["train"]["start"], str if telemetry.epoch_ns is not None else float)


def test_a_single_node_gets_an_answer() -> None:
    """Its neighbour is not declared: the loop sees a mass behind a conductance, as it is."""
    spec = conductive_spec(1, [], channels={"Q": POWER}, loads=[{"channel": "Q", "node": "n0"}])
    loop = close_loop(load_spec(spec), [record()])
    assert [f["effect"] for f in loop.report["findings"]] == ["hidden_mass"]
    parameters = loop.report["findings"][0]["parameters"]
    assert parameters["C_J_per_K"]["mean"] == pytest.approx(7.0e3, rel=0.1)
    assert parameters["G_W_per_K"]["mean"] == pytest.approx(2.5, rel=0.1)


@pytest.mark.parametrize(
    ("data", "more", "message"),
    [
        (PAIR, {"T1": np.where(LATE, readings()["T1"], np.nan)}, "channel 'T1' has no usable samples"),
        (PAIR, {"Q": np.where(LATE, 10.0, np.nan)}, "channel 'Q' has no samples"),
        (PAIR, {"Q": np.where(np.arange(N_TIMES) < 60, 10.0, np.nan)}, "channel 'Q' has no samples in the hold-out"),
        (edited(exclude=[{"start": 0.0, "stop": 1e9}]), {}, "no usable sample of T0, T1"),
    ],
)
def test_what_cannot_be_used_is_named(data: dict[str, Any], more: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(TelemetryError, match=message):
        close_loop(load_spec(data), [record(**more)])


def test_a_wrong_unit_is_told_whatever_physics_would_stand_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """One sensor reads K and is taken for degC: the effect that stands for it, a heater, is given up for the mistake."""
    monkeypatch.setattr(REGISTRY, "_kinds", {name: REGISTRY[name] for name in ("proportional_heater", "sensor_lag")})
    report = close_loop(load_spec(PAIR), [record(T0=readings()["T0"] + 273.15)]).report
    assert report["findings"] == []
    assert MISTAKE in {row["reason"] for row in report["not_supported"]}
    told = [row for row in report["suspicions"] if row["mistake"] == "unit"]
    assert told and told[0]["where"] == ["T0"]
    assert told[0]["misfit"] < 2.0
    assert report["notices"][0].startswith("perhaps channel 'T0' is in K, not in degC")


def test_nothing_is_suspected_where_the_model_suffices() -> None:
    assert close_loop(load_spec(PAIR), [record()]).report["suspicions"] == []
