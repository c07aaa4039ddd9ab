"""Heat flows against hand calculation, and their sum against the balance."""

import numpy as np
import pytest

from tests.twin_core.network.test_declared_terms import data, record
from twin_core.calibrate.result import CalibratedModel
from twin_core.effects import effect_from_json
from twin_core.flows import heat_flows
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

SPEC = load_spec(
    {
        "twin": "t",
        "boundaries": {"space": {"value_K": 3.0}, "room": {"channel": "T_room"}},
        "channels": {
            "T_a": {"kind": "temperature", "unit": "K"},
            "T_room": {"kind": "temperature", "unit": "degC"},
            "Q": {"kind": "power", "unit": "W"},
        },
        "nodes": [{"id": "a", "sensor": "T_a"}, {"id": "b"}],
        "conductors": [
            {"between": ["a", "b"], "conductance_W_per_K": {"value": 2.0}},
            {"between": ["b", "room"], "conductance_W_per_K": {"value": 0.5}},
        ],
        "radiators": [{"node": "a", "emissivity": 0.5, "area_m2": 0.2, "sink": "space"}],
        "loads": [{"channel": "Q", "node": "a", "weight": 0.25}],
    }
)


def make_model() -> CalibratedModel:
    effect = effect_from_json(
        {"effect": "constant_heat_load", "where": {"node": "b"}, "settings": {}, "values": {"Q_W": 7.0}}, 0
    )
    bare = CalibratedModel(SPEC, (effect,), {}, np.zeros((0, 0)), (), {"T_a": 0.1}, {"T_a": 0.0}, {"T_a": 1.0}, 60.0)
    parameters = bare.network().parameters
    values = {p.name: p.value for p in parameters.parameters}
    return CalibratedModel(
        SPEC, (effect,), values, np.zeros((0, 0)), (), {"T_a": 0.1}, {"T_a": 0.0}, {"T_a": 1.0}, 60.0
    )


def test_every_flow_by_hand() -> None:
    record = Record(np.array([5.0]), {"T_a": np.array([300.0]), "T_room": np.array([290.0]), "Q": np.array([40.0])})
    found = heat_flows(make_model(), record, {"mean_K": [300.0, 295.0]})
    conductor, wall, radiator = found["links"]
    assert (conductor["ends"], conductor["heat_W"]) == (["a", "b"], pytest.approx(10.0))
    assert (wall["ends"], wall["heat_W"]) == (["b", "room"], pytest.approx(2.5))
    radiated = 5.670374419e-8 * 0.1 * (300.0**4 - 3.0**4)
    assert (radiator["kind"], radiator["heat_W"]) == ("radiator", pytest.approx(radiated))
    assert found["loads"] == [{"channel": "Q", "node": "a", "heat_W": pytest.approx(10.0)}]
    assert found["effects"][0]["heat_W"] == {"b": pytest.approx(7.0)}
    net = {node["id"]: node["heat_W"] for node in found["nodes"]}
    assert net == {"a": pytest.approx(10.0 - 10.0 - radiated), "b": pytest.approx(10.0 - 2.5 + 7.0)}
    assert [node["sensed"] for node in found["nodes"]] == [True, False]
    assert {b["id"]: b["temperature_K"] for b in found["boundaries"]} == {"space": 3.0, "room": 290.0}


def test_the_heats_of_every_declared_term_add_up() -> None:
    """Radiation between nodes, one-way conductors, heaters and derived channels; a node that stores nothing is in balance."""
    spec = load_spec(data())
    zero = dict.fromkeys(spec.sensors, 0.1)
    values = build_network(spec).parameters.as_dict()
    model = CalibratedModel(spec, (), values, np.zeros((0, 0)), (), zero, zero, zero, 60.0)
    found = heat_flows(model, record(), {"mean_K": [280.0, 260.0, 250.0, 299.0]})
    net = {node["id"]: 0.0 for node in found["nodes"]}
    for link in found["links"]:
        first, second = link["ends"]
        if first in net and not link.get("one_way"):
            net[first] -= link["heat_W"]
        if second in net:
            net[second] += link["heat_W"]
    for entry in (*found["loads"], *found["heaters"]):
        net[entry["node"]] += entry["heat_W"]
    assert net == pytest.approx({node["id"]: node["heat_W"] for node in found["nodes"]}, abs=1e-9)
    assert [heater["heat_W"] for heater in found["heaters"]] == pytest.approx([0.5 * 12.0, 0.7])
