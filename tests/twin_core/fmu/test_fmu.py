"""The exported unit, run by FMPy: its temperatures are those of the rollout, its rates those of the balance."""

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core._typing import FloatArray
from twin_core.calibrate.result import CalibratedModel
from twin_core.effects import effect_from_json
from twin_core.errors import ModelError
from twin_core.fmu import c_source, model_description, write_fmu
from twin_core.network.dynamics import reading_offsets_K
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

fmpy = pytest.importorskip("fmpy")
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine")

SPEC: dict[str, Any] = {
    "twin": "unit",
    "boundaries": {"space": {"value_K": 2.7}, "room": {"channel": "T_room"}, "wall": {"guess_K": 281.0}},
    "channels": {
        "T_a": {"kind": "temperature", "unit": "degC"},
        "T_b": {"kind": "temperature", "unit": "K"},
        "T_room": {"kind": "temperature", "unit": "degC", "interpolation": "hold"},
        "Q": {"kind": "power", "unit": "W"},
        "pitch": {"kind": "auxiliary", "unit": "deg", "interpolation": "hold"},
    },
    "nodes": [
        {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"value": 4.0e4}},
        {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"value": 9.0e4}},
        {"id": "c", "capacity_J_per_K": {"value": 2.0e4}},
    ],
    "conductors": [
        {"between": ["a", "b"], "conductance_W_per_K": {"value": 3.0}},
        {"between": ["b", "room"], "conductance_W_per_K": {"value": 0.7}},
        {"between": ["c", "wall"], "conductance_W_per_K": {"value": 0.4}},
        {"between": ["c", "a"], "conductance_W_per_K": {"value": 0.3}, "into": "c"},
    ],
    "radiators": [{"node": "a", "emissivity": 0.8, "area_m2": 0.3, "sink": "space"}],
    "radiation": [{"between": ["b", "c"], "area_m2": {"value": 0.05}}],
    "derived": {
        "lit": {"formula": "where(pitch > 90, max(cos(radians(pitch)), -0.5) ** 2, 0.25) * round(1.4)", "unit": "W"}
    },
    "loads": [
        {"channel": "Q", "node": "a", "weight": 0.75},
        {"channel": "Q", "node": "b", "weight": 0.25},
        {"channel": "lit", "node": "b", "gain": {"value": 30.0}},
        {"channel": "pitch", "node": "a", "table": {"knots": [45, 90, 135, 180], "values_W": [5.0, 12.0, 3.0, 1.0]}},
    ],
    "heaters": [
        {"node": "c", "proportional": {"gain_W_per_K": {"value": 2.0}, "set_K": 285.0, "most_W": {"value": 6.0}}}
    ],
}
EFFECTS: list[dict[str, Any]] = [
    {"effect": "missing_conductor", "where": {"nodes": ["a", "c"]}, "values": {"G_W_per_K": 0.8}},
    {"effect": "radiation_to_sink", "where": {"node": "b", "sink": "space"}, "values": {"R_m2": 0.06}},
    {"effect": "hidden_mass", "where": {"node": "b"}, "values": {"C_J_per_K": 3e4, "G_W_per_K": 0.9}},
    {"effect": "nonlinear_convection", "where": {"node": "a", "boundary": "room"}, "values": {"k": 0.3, "p": 1.25}},
    {"effect": "input_gain", "where": {"channel": "Q"}, "values": {"g": 0.9}},
    {"effect": "constant_heat_load", "where": {"node": "b"}, "values": {"Q_W": 2.5}},
    {
        "effect": "channel_heat_load",
        "where": {"node": "c", "channel": "pitch"},
        "values": {"values_W[0]": 3.0, "values_W[1]": -2.0, "values_W[2]": 5.0},
        "settings": {
            "knots": [40, 110, 180],
            "levels": False,
            "held": ["values_W[1]"],
            "visits": [0.5, 0.3, 0.2],
        },
    },
    {"effect": "sensor_lag", "where": {"sensor": "T_b"}, "values": {"tau_s": 400.0}},
    {"effect": "boundary_offset", "where": {"boundary": "room"}, "values": {"b_K": 1.5}},
]


def make_model(effects: list[dict[str, Any]] = EFFECTS, changes: Mapping[str, Any] | None = None) -> CalibratedModel:
    spec = load_spec(SPEC | dict(changes or {}))
    told = tuple(effect_from_json({"settings": {}, **item}, i) for i, item in enumerate(effects))
    sensors = dict.fromkeys(spec.sensors, 0.1)
    values = build_network(spec, told).parameters.as_dict()
    return CalibratedModel(spec, told, values, np.zeros((0, 0)), (), sensors, sensors, sensors, 20.0)


def flight(dt_s: float = 600.0, n: int = 40) -> Record:
    """Inputs that step with every sample."""
    time_s, rng = dt_s * np.arange(n), np.random.default_rng(1)
    columns = {
        "T_room": 290.0 + rng.uniform(-3.0, 3.0, n),
        "Q": rng.choice([0.0, 40.0, 90.0], n),
        "pitch": rng.uniform(30.0, 190.0, n),
    }
    return Record(time_s, columns)


START_K = np.array([295.0, 288.0, 279.0, 288.0, 288.0])


SWITCHED: list[dict[str, Any]] = [
    {"node": "a", "thermostat": {"on_K": 287.0, "off_K": 287.5, "power_W": {"value": 45.0}}}
]
STORING: list[dict[str, Any]] = [
    {
        "effect": "capacity_temperature",
        "where": {"node": "a"},
        "values": {"kappa_per_K": 4e-3},
        "settings": {"T_ref_K": 290.0},
    },
    {"effect": "latent_heat", "where": {"node": "b"}, "values": {"L_J": 1.5e5, "T_m_K": 287.0, "w_K": 0.7}},
    {
        "effect": "thermostat_heater",
        "where": {"node": "a"},
        "values": {"Q_W": 60.0, "T_on_K": 286.7, "T_off_K": 287.3},
        "settings": {"off_state_K": 286.7, "on_state_K": 287.3, "rate_K_per_s": 1e-3, "delay_s": 0.5},
    },
]
STORED_K = np.array([288.0, 288.0, 279.0, 287.0, 286.7])
"""Where the nodes begin, and the memories of both thermostats: off."""


def rolled_out(
    model: CalibratedModel, record: Record, step_s: float, start_K: FloatArray = START_K
) -> tuple[FloatArray, FloatArray]:
    """Return states (n_samples, n_states) and readings in K."""
    network = model.network()
    forcing = build_forcing(network, record, step_s)
    path = rollout(network, network.parameters.values, start_K, forcing)
    assert path.converged
    states = path.at_samples(forcing.sample_step)
    offsets = reading_offsets_K(network, network.parameters.values, record.clock_s)
    return states, states[:, network.sensor_node] + offsets


@contextmanager
def unit(model: CalibratedModel, kind: str) -> Iterator[tuple[Any, dict[str, int], Any]]:
    """Yield the unit in initialisation mode, its value references, and its description."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "unit.fmu"
        assert write_fmu(model, path)["platform"] is not None
        described = fmpy.read_model_description(str(path), validate=True)
        assert not fmpy.validation.validate_fmu(str(path)) if hasattr(fmpy, "validation") else True
        unzipped = fmpy.extract(str(path), unzipdir=f"{folder}/unzipped")
        make = fmpy.fmi3.FMU3Slave if kind == "cs" else fmpy.fmi3.FMU3Model
        identifier = (described.coSimulation if kind == "cs" else described.modelExchange).modelIdentifier
        instance = make(guid=described.guid, unzipDirectory=unzipped, modelIdentifier=identifier, instanceName="one")
        instance.instantiate()
        yield instance, {v.name: v.valueReference for v in described.modelVariables}, described
        instance.freeInstance()


def set_inputs(instance: Any, at: dict[str, int], record: Record, k: int) -> None:
    """Hold the inputs of one sample, in the channels' own units."""
    values = {
        "T_room": record.values["T_room"][k] - 273.15,
        "Q": record.values["Q"][k],
        "pitch": record.values["pitch"][k],
    }
    instance.setFloat64([at[name] for name in values], list(map(float, values.values())))


def test_co_simulation_is_the_rollout() -> None:
    """Against a rollout whose steps are so short that halving them changes it by less than what is asked."""
    model, record = make_model(), flight()
    (states, readings), (coarser, _) = rolled_out(model, record, 0.5), rolled_out(model, record, 1.0)
    assert np.abs(states - coarser).max() < 1e-6
    with unit(model, "cs") as (instance, at, _):
        instance.setFloat64([at[f"node.{n}"] for n in model.network().nodes], START_K.tolist())
        instance.enterInitializationMode(startTime=0.0)
        instance.exitInitializationMode()
        found, read = [START_K], []
        for k in range(record.time_s.size - 1):
            set_inputs(instance, at, record, k)
            step = float(record.time_s[k + 1] - record.time_s[k])
            instance.doStep(currentCommunicationPoint=float(record.time_s[k]), communicationStepSize=step)
            found.append(np.array(instance.getFloat64([at[f"node.{n}"] for n in model.network().nodes])))
            read.append(instance.getFloat64([at["T_a"], at["T_b"]]))
        instance.terminate()
    assert np.abs(np.array(found) - states).max() < 1e-6
    np.testing.assert_allclose(np.array(read) + np.array([273.15, 0.0]), readings[1:], atol=1e-6)


def test_model_exchange_is_the_rollout() -> None:
    """Its rates, integrated by SciPy."""
    model, record = make_model(), flight(n=12)
    states, _ = rolled_out(model, record, 0.5)
    with unit(model, "me") as (instance, at, _):
        instance.enterInitializationMode(startTime=0.0)
        instance.exitInitializationMode()
        instance.enterContinuousTimeMode()
        n = START_K.size

        def rates(time_s: float, state_K: FloatArray) -> FloatArray:
            instance.setTime(float(time_s))
            held = (fmpy.fmi3.fmi3Float64 * n)(*state_K.tolist())
            told = (fmpy.fmi3.fmi3Float64 * n)()
            instance.setContinuousStates(held, n)
            instance.getContinuousStateDerivatives(told, n)
            return np.array(told)

        state = START_K
        for k in range(record.time_s.size - 1):
            set_inputs(instance, at, record, k)
            span = (float(record.time_s[k]), float(record.time_s[k + 1]))
            state = solve_ivp(rates, span, state, method="DOP853", rtol=1e-12, atol=1e-9).y[:, -1]
            np.testing.assert_allclose(state, states[k + 1], atol=1e-6)
        instance.terminate()


def test_thermostats_and_capacities_that_change_are_the_rollout() -> None:
    """Co-simulation finds every switching by itself; the memories, which a rollout lets settle, are where they settle."""
    model, record = make_model(STORING, {"heaters": SWITCHED}), flight(n=24)
    (states, _), (coarser, _) = (rolled_out(model, record, step, STORED_K) for step in (0.5, 1.0))
    assert np.abs(states - coarser)[:, :3].max() < 1e-6
    switched = [np.count_nonzero(np.diff(states[:, k] > STORED_K[k] + 0.25)) for k in (3, 4)]
    assert min(switched) >= 2 and sum(switched) >= 5  # between samples; within them there are more
    with unit(model, "cs") as (instance, at, _):
        names = [at[f"node.{n}"] for n in model.network().nodes]
        instance.setFloat64(names, STORED_K.tolist())
        instance.enterInitializationMode(startTime=0.0)
        instance.exitInitializationMode()
        found = [STORED_K]
        for k in range(record.time_s.size - 1):
            set_inputs(instance, at, record, k)
            step = float(record.time_s[k + 1] - record.time_s[k])
            instance.doStep(currentCommunicationPoint=float(record.time_s[k]), communicationStepSize=step)
            found.append(np.array(instance.getFloat64(names)))
        instance.terminate()
    assert np.abs(np.array(found) - states)[:, :3].max() < 1e-6
    np.testing.assert_allclose(np.array(found)[:, 3:], states[:, 3:], atol=0.1)


def test_events_of_a_thermostat_are_found_by_their_indicators() -> None:
    """SciPy integrates between events, ends at a zero of an indicator, and asks the unit to switch."""
    strong = [{"node": "a", "thermostat": SWITCHED[0]["thermostat"] | {"power_W": {"value": 120.0}}}]
    model, record = make_model([], {"heaters": strong}), flight(n=12)
    start_K = STORED_K[:4]
    states, _ = rolled_out(model, record, 0.5, start_K)
    with unit(model, "me") as (instance, at, described):
        names = [at[f"node.{n}"] for n in model.network().nodes]
        instance.setFloat64(names, start_K.tolist())
        instance.enterInitializationMode(startTime=0.0)
        instance.exitInitializationMode()
        instance.enterContinuousTimeMode()
        n, n_indicators = start_K.size, described.numberOfEventIndicators
        assert n_indicators == 2

        def place(time_s: float, state_K: FloatArray) -> None:
            instance.setTime(float(time_s))
            instance.setContinuousStates((fmpy.fmi3.fmi3Float64 * n)(*state_K.tolist()), n)

        def rates(time_s: float, state_K: FloatArray) -> FloatArray:
            place(time_s, state_K)
            told = (fmpy.fmi3.fmi3Float64 * n)()
            instance.getContinuousStateDerivatives(told, n)
            return np.array(told)

        def indicator(which: int) -> Any:
            def falls(time_s: float, state_K: FloatArray) -> float:
                place(time_s, state_K)
                told = (fmpy.fmi3.fmi3Float64 * n_indicators)()
                instance.getEventIndicators(told, n_indicators)
                return float(told[which])

            falls.terminal, falls.direction = True, -1.0  # type: ignore[attr-defined]
            return falls

        state, events = start_K, 0
        for k in range(record.time_s.size - 1):
            set_inputs(instance, at, record, k)
            now, stop = float(record.time_s[k]), float(record.time_s[k + 1])
            while now < stop:
                part = solve_ivp(
                    rates,
                    (now, stop),
                    state,
                    method="DOP853",
                    rtol=1e-12,
                    atol=1e-9,
                    events=[indicator(0), indicator(1)],
                )
                now, state = float(part.t[-1]), part.y[:, -1]
                if part.status == 1:
                    place(now, state)
                    instance.enterEventMode()
                    assert instance.updateDiscreteStates()[3]  # the memory has changed
                    events += 1
                    instance.enterContinuousTimeMode()
                    state = np.array(instance.getFloat64(names))
            np.testing.assert_allclose(state[:3], states[k + 1, :3], atol=1e-6)
        instance.terminate()
    assert events >= 2


def test_a_state_is_kept_and_restored_and_a_parameter_changed() -> None:
    model, record = make_model(), flight()
    with unit(model, "cs") as (instance, at, _):
        instance.setFloat64([at["C:a"]], [8.0e4])
        assert instance.getFloat64([at["C:a"]]) == [8.0e4]
        instance.enterInitializationMode(startTime=0.0)
        instance.exitInitializationMode()
        set_inputs(instance, at, record, 0)
        before = instance.getFloat64([at["node.a"]])
        kept = instance.getFMUState()
        instance.doStep(currentCommunicationPoint=0.0, communicationStepSize=600.0)
        assert instance.getFloat64([at["node.a"]]) != before
        instance.setFMUState(kept)
        assert instance.getFloat64([at["node.a"]]) == before
        instance.freeFMUState(kept)
        with pytest.raises(Exception, match="fmi3DoStep"):
            instance.doStep(currentCommunicationPoint=7.0, communicationStepSize=600.0)


def test_stiff_nodes_cost_no_short_steps() -> None:
    """A node that stores next to nothing: the unit ends at the balance of its neighbours."""
    nodes = [*SPEC["nodes"][:2], {"id": "c", "capacity_J_per_K": {"value": 0.0}}]
    model, record = make_model([], {"nodes": nodes}), flight()
    network = model.network()
    with unit(model, "cs") as (instance, at, _):
        instance.enterInitializationMode(startTime=0.0)
        instance.exitInitializationMode()
        set_inputs(instance, at, record, 3)
        instance.doStep(currentCommunicationPoint=0.0, communicationStepSize=5e6)
        found = np.array(instance.getFloat64([at[f"node.{n}"] for n in network.nodes]))
        rates = instance.getFloat64([at[f"der(node.{n})"] for n in network.nodes])
    assert np.abs(np.array(rates) * [4e4, 9e4, 1.0]).max() < 1e-4 and (found > 200.0).all()


def test_what_has_no_form_is_refused_by_name() -> None:
    drift = {
        "effect": "input_drift",
        "where": {"channel": "Q"},
        "values": {"r_per_s": 1e-6},
        "settings": {"t0_s": 0.0, "dated": False},
    }
    with pytest.raises(ModelError, match="input_drift"):
        c_source(make_model([drift]))
    lag = {"effect": "boundary_lag", "where": {"boundary": "room"}, "values": {"tau_s": 300.0}}
    with pytest.raises(ModelError, match="boundary"):
        c_source(make_model([lag]))


def test_the_same_model_is_the_same_unit() -> None:
    assert c_source(make_model()) == c_source(make_model())
    other = replace(make_model(), values=make_model().values | {"C:a": 5.0e4})
    assert model_description(other) != model_description(make_model())
