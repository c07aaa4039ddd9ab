"""Correlation against phases at rest and transients, against what can be worked out by hand and what SciPy integrates."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from twin_core._typing import FloatArray
from twin_core.calibrate.phases import Phase, at_rest, correlate, weight_of
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.errors import ModelError, TelemetryError
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

TRUTH = {"G:a|b": 1.6, "G:b|plate": 0.9, "G:b|inner": 0.25, "C:a": 3000.0, "C:b": 5000.0, "C:inner": 2500.0}
AREA = 0.04


def spec(**more: Any) -> TwinSpec:
    return load_spec(
        {
            "twin": "balance",
            "boundaries": {"space": {"value_K": 80.0}, "plate": {"channel": "T_plate"}},
            "channels": {
                "T_a": {"kind": "temperature", "unit": "degC"},
                "T_b": {"kind": "temperature", "unit": "degC"},
                "T_plate": {"kind": "temperature", "unit": "degC"},
                "Q": {"kind": "power", "unit": "W"},
            },
            "nodes": [
                {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 4000.0}},
                {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"guess": 4000.0}},
                {"id": "inner", "capacity_J_per_K": {"guess": 2000.0}},
            ],
            "conductors": [
                {"between": ["a", "b"], "conductance_W_per_K": {"guess": 1.0}},
                {"between": ["b", "plate"], "conductance_W_per_K": {"guess": 1.5}},
                {"between": ["b", "inner"], "conductance_W_per_K": {"guess": 0.5}},
            ],
            "radiators": [{"node": "a", "emissivity": 0.8, "area_m2": AREA / 0.8, "sink": "space"}],
            "loads": [{"channel": "Q", "node": "a", "weight": 0.8}, {"channel": "Q", "node": "inner", "weight": 0.2}],
        }
        | more
    )


def rates(state_K: FloatArray, heat_W: float, plate_K: float) -> FloatArray:
    a, b, inner = state_K
    q_ab, q_bi = TRUTH["G:a|b"] * (a - b), TRUTH["G:b|inner"] * (b - inner)
    q_bp = TRUTH["G:b|plate"] * (b - plate_K)
    into = [0.8 * heat_W - q_ab - SIGMA * AREA * (a**4 - 80.0**4), q_ab - q_bp - q_bi, 0.2 * heat_W + q_bi]
    return np.array(into) / [TRUTH["C:a"], TRUTH["C:b"], TRUTH["C:inner"]]


def rest(heat_W: float, plate_C: float) -> dict[str, float]:
    a, b, _ = fsolve(lambda s: rates(s, heat_W, plate_C + 273.15), np.full(3, 290.0), xtol=1e-12)
    return {"T_a": a - 273.15, "T_b": b - 273.15, "T_plate": plate_C, "Q": heat_W}


def transient() -> Record:
    time_s = np.arange(0.0, 40_000.0, 100.0)
    heat = np.where(time_s < 15_000.0, 40.0, 5.0)
    state, states = np.full(3, 300.0), []
    for k in range(time_s.size):
        states.append(state)
        state = solve_ivp(lambda t, s, q=heat[k]: rates(s, q, 285.0), (0.0, 100.0), state, rtol=1e-9, atol=1e-9).y[
            :, -1
        ]
    rng, read = np.random.default_rng(0), np.array(states)[:, :2]
    noisy = read + rng.normal(0.0, 0.05, read.shape)
    columns = {"T_a": noisy[:, 0], "T_b": noisy[:, 1], "T_plate": np.full(time_s.size, 285.0), "Q": heat}
    return Record(time_s, columns, name="transient")


def test_one_conductance_from_two_phases_at_rest_is_ohms_law() -> None:
    """q = G (T_b - T_plate) for all of the heat that does not radiate: no capacity is told, the conductance exactly."""
    told = {key: {"value": value} for key, value in TRUTH.items() if key.startswith("G")}
    known = spec(
        conductors=[
            {"between": ["a", "b"], "conductance_W_per_K": told["G:a|b"]},
            {"between": ["b", "plate"], "conductance_W_per_K": {"guess": 3.0}},
            {"between": ["b", "inner"], "conductance_W_per_K": told["G:b|inner"]},
        ]
    )
    phases = [at_rest(known, name, rest(*given)) for name, given in (("hot", (60.0, 30.0)), ("cold", (10.0, -20.0)))]
    found = correlate(known, phases)
    assert found.model.values["G:b|plate"] == pytest.approx(TRUTH["G:b|plate"], rel=1e-3)
    rows = {row["name"]: row for row in found.report["parameters"]}
    assert rows["G:b|plate"]["identified"] and not rows["C:inner"]["identified"]
    assert [phase["phase"] for phase in found.report["phases"]] == ["hot", "cold"]
    assert found.report["after"]["rmse_K"] < 0.02 < 1.0 < found.report["before"]["rmse_K"]


def test_phases_at_rest_that_one_conductance_cannot_meet_leave_capacities_alone() -> None:
    """T = T_wall + Q / G meets neither phase exactly: a large capacity would let the model linger at the readings."""
    data = {
        "twin": "one",
        "boundaries": {"wall": {"channel": "T_wall"}},
        "channels": {
            "T": {"kind": "temperature", "unit": "degC", "noise_std": 0.1},
            "T_wall": {"kind": "temperature", "unit": "degC"},
            "Q": {"kind": "power", "unit": "W"},
        },
        "nodes": [{"id": "a", "sensor": "T", "capacity_J_per_K": {"guess": 500.0}}],
        "conductors": [{"between": ["a", "wall"], "conductance_W_per_K": {"guess": 1.0}}],
        "loads": [{"channel": "Q", "node": "a"}],
    }
    declared = load_spec(data)
    read = {"hot": {"T": 45.1, "T_wall": 20.0, "Q": 20.0}, "cold": {"T": -5.0, "T_wall": -20.0, "Q": 12.0}}
    found = correlate(declared, [at_rest(declared, name, values) for name, values in read.items()])
    assert found.model.values["C:a"] == 500.0
    assert any("C:a" in notice for notice in found.report["notices"])
    least_squares = (20.0**2 + 12.0**2) / (25.1 * 20.0 + 15.0 * 12.0)
    assert found.model.values["G:a|wall"] == pytest.approx(least_squares, rel=1e-3)


def test_one_sensor_on_many_nodes_at_rest_tells_a_conductance() -> None:
    """All nodes hang on the one that has the sensor, so that each is as warm as it: G = Q / (T - T_wall)."""
    hidden = [f"n{i}" for i in range(60)]
    data = {
        "twin": "many",
        "boundaries": {"wall": {"value_K": 290.0}},
        "channels": {"T": {"kind": "temperature", "unit": "K"}, "Q": {"kind": "power", "unit": "W"}},
        "nodes": [
            {"id": "a", "sensor": "T", "capacity_J_per_K": {"value": 900.0}},
            *({"id": name, "capacity_J_per_K": {"value": 50.0}} for name in hidden),
        ],
        "conductors": [
            {"between": ["a", "wall"], "conductance_W_per_K": {"guess": 1.0}},
            *({"between": ["a", name], "conductance_W_per_K": {"value": 0.5}} for name in hidden),
        ],
        "loads": [{"channel": "Q", "node": "a"}],
    }
    declared = load_spec(data)
    found = correlate(declared, [at_rest(declared, "hot", {"T": 310.0, "Q": 12.0})])
    assert found.model.values["G:a|wall"] == pytest.approx(0.6, rel=0.01)


def test_hot_cold_and_transient_together() -> None:
    declared, flown = spec(), transient()
    n = weight_of([flown])
    phases = [
        at_rest(declared, "hot", rest(60.0, 30.0), samples=n),
        at_rest(declared, "cold", rest(10.0, -20.0), samples=n),
        Phase("transient", flown, False),
    ]
    assert n == flown.time_s.size
    found = correlate(declared, phases)
    for name, value in TRUTH.items():
        assert found.model.values[name] == pytest.approx(value, rel=0.05), name
    for phase in found.report["phases"]:
        assert phase["after"]["met"] and phase["after"]["rmse_K"] < 0.07
        assert phase["before"]["rmse_K"] > phase["after"]["rmse_K"]
    assert all(abs(found.model.noise_K[s] - 0.05) < 0.01 for s in declared.sensors)


def test_what_cannot_rest_is_refused() -> None:
    declared = spec()
    with pytest.raises(TelemetryError, match="'Q' is missing"):
        at_rest(declared, "hot", {"T_a": 20.0, "T_plate": 10.0})
    with pytest.raises(TelemetryError, match="no sensor was read"):
        at_rest(declared, "hot", {"Q": 20.0, "T_plate": 10.0})
    afloat = spec(
        boundaries={"plate": {"channel": "T_plate"}},
        radiators=[],
        conductors=[
            {"between": ["b", "plate"], "conductance_W_per_K": {"guess": 1.5}},
            {"between": ["b", "inner"], "conductance_W_per_K": {"guess": 0.5}},
        ],
    )
    with pytest.raises(ModelError, match="no way to lose heat"):
        at_rest(afloat, "hot", {"T_a": 20.0, "T_b": 20.0, "Q": 1.0, "T_plate": 10.0})
    phase = at_rest(declared, "hot", rest(60.0, 30.0))
    with pytest.raises(TelemetryError, match="two phases have this name"):
        correlate(declared, [phase, phase])
