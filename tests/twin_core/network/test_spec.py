"""The specification: what is accepted, what it means, and that it survives being written down.

What is refused stands in tests/test_bad_input.py.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from twin_core.errors import SpecError
from twin_core.network.quantities import guess_or
from twin_core.network.spec_io import dump_spec, load_spec

FULL = """
twin: benchsat
boundaries:
  space: {value_K: 2.7}
  room:  {channel: T_ambient}
  sink:  {guess_K: 260}
channels:
  T_px:   {kind: temperature, unit: K,    noise_std: 0.1}
  T_tank: {kind: temperature, unit: degC}
  T_ambient: {kind: temperature, unit: degC}
  Q_px:   {kind: power,       unit: W}
  H1:     {kind: power,       unit: W}
  H2:     {kind: power,       unit: percent, interpolation: linear}
  Q_sun:  {kind: power,       unit: W}
  pitch:  {kind: auxiliary,   unit: deg}
  mode:   {kind: auxiliary,   levels: true}
nodes:
  - {id: px,  sensor: T_px, capacity_J_per_K: {guess: 4.0e5}}
  - {id: tank, sensor: T_tank, capacity_J_per_K: {value: 9.0e4}}
  - {id: inner}
conductors:
  - {between: [px, tank], conductance_W_per_K: {guess: 5.0, bounds: [1.0, 20.0]}}
  - {between: [inner, tank]}
  - {between: [inner, room]}
radiators:
  - {node: px, emissivity: 0.8, area_m2: 2.0, sink: space}
  - {node: inner, emissivity: 0.8, area_m2: 2.0, sink: sink}
loads:
  - {channel: Q_px, node: px}
  - {channel: H1, node: tank, weight: 0.5}
  - {channel: H1, node: px, weight: 0.5}
  - {channel: H2, node: tank, gain: {guess: 0.03}}
  - {channel: Q_sun, node: px, solar: true}
  - {channel: pitch, node: px, solar: true, table: {knots: [45, 90, 135, 180]}}
  - {channel: mode, node: tank, table: {}}
exclude:
  - {start: 2026-01-03T00:00:00Z, stop: "2026-01-03T06:00:00Z", reason: safe mode}
criteria: {bias_K: 1.0, q99_abs_K: 3.0}
"""


def test_every_field_in_yaml_and_json(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(FULL)
    spec = load_spec(tmp_path / "a.yaml")
    (tmp_path / "a.json").write_text(json.dumps(dump_spec(spec)))
    assert load_spec(tmp_path / "a.json") == spec
    assert load_spec(str(tmp_path / "a.yaml")) == spec
    assert load_spec(dump_spec(spec)) == spec


def test_derived_names(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(FULL)
    spec = load_spec(tmp_path / "a.yaml")
    assert spec.sensors == ("T_px", "T_tank")
    assert spec.used_channels == tuple(spec.channels)
    assert spec.noise_std_K("T_px") == 0.1
    assert spec.noise_std_K("T_tank") is None


@pytest.mark.parametrize(
    ("channel", "is_held"),
    [("T_px", False), ("Q_px", True), ("H2", False), ("pitch", False), ("mode", True)],
)
def test_what_holds_between_samples(tmp_path: Path, channel: str, is_held: bool) -> None:
    (tmp_path / "a.yaml").write_text(FULL)
    assert load_spec(tmp_path / "a.yaml").channels[channel].is_held is is_held


def test_what_stands_twice_is_told_beside_faults_of_form(pair: dict[str, Any]) -> None:
    pair["nodes"][1]["id"] = pair["nodes"][0]["id"]
    pair["channels"]["T_a"]["unit"] = "furlong"
    with pytest.raises(SpecError) as told:
        load_spec(pair)
    assert {"channels.T_a", "nodes[1].id"} <= {line.split(": ")[0] for line in told.value.problems}


def test_unused_temperature_channel_is_no_demand(pair: dict[str, Any]) -> None:
    pair["channels"]["T_spare"] = {"kind": "temperature", "unit": "K"}
    assert "T_spare" not in load_spec(pair).used_channels


def test_several_sensors_of_one_node(pair: dict[str, Any]) -> None:
    pair["nodes"] = [{"id": "a", "sensor": ["T_a", "T_b"]}]
    pair["conductors"] = []
    assert load_spec(pair).sensors == ("T_a", "T_b")


@pytest.mark.parametrize(
    ("field", "item", "message"),
    [
        ("radiators", {"node": "a", "emissivity": 0.1, "area_m2": 1, "sink": "space"}, "radiates to 'space' twice"),
        ("loads", {"channel": "Q_a", "node": "a", "weight": 0.1}, "heats node 'a' twice"),
        ("conductors", {"between": ["b", "a"]}, "are joined twice"),
    ],
)
def test_doubled_parts(pair: dict[str, Any], field: str, item: dict[str, Any], message: str) -> None:
    pair[field].append(item)
    with pytest.raises(SpecError, match=message):
        load_spec(pair)


def test_weights_beyond_one(pair: dict[str, Any]) -> None:
    pair["loads"] = [{"channel": "Q_a", "node": "a", "weight": 0.7}, {"channel": "Q_a", "node": "b", "weight": 0.7}]
    with pytest.raises(SpecError, match=r"weights of channel 'Q_a' add to 1\.4"):
        load_spec(pair)


def test_guess_or(pair: dict[str, Any]) -> None:
    pair["nodes"][0]["capacity_J_per_K"] = {"bounds": [1.0, 100.0]}
    pair["nodes"][1]["capacity_J_per_K"] = {"value": 7.0}
    bounded, known = (node.capacity_J_per_K for node in load_spec(pair).nodes)
    assert guess_or(bounded, 5.0) == pytest.approx(10.0)  # the geometric mean of the bounds
    assert guess_or(known, 5.0) == 7.0
    assert guess_or(None, 5.0) == 5.0


def test_a_table_explains_no_heat(pair: dict[str, Any]) -> None:
    pair["channels"]["Q_extra"] = {"kind": "power", "unit": "W"}
    pair["loads"] = [{"channel": "Q_extra", "node": pair["nodes"][0]["id"], "table": {"knots": [0, 1]}}]
    with pytest.raises(SpecError, match=r"loads\[0\]\.table: 'Q_extra' is heat already"):
        load_spec(pair)


def test_a_boundary_is_no_modelled_node(pair: dict[str, Any]) -> None:
    sensor = pair["nodes"][0]["sensor"]
    pair["boundaries"] = {"wall": {"channel": sensor}}
    with pytest.raises(SpecError, match=r"boundaries\.wall\.channel: .* reads node"):
        load_spec(pair)


def test_solar_is_true_or_false(pair: dict[str, Any]) -> None:
    pair["channels"]["Q_sun"] = {"kind": "power", "unit": "W"}
    pair["loads"] = [{"channel": "Q_sun", "node": pair["nodes"][0]["id"], "solar": "yes"}]
    with pytest.raises(SpecError, match=r"loads\[0\]\.solar"):
        load_spec(pair)


def test_hidden_nodes_that_no_sensor_sees_are_refused() -> None:
    spec = {
        "twin": "ring",
        "channels": {"T": {"kind": "temperature", "unit": "K"}},
        "nodes": [{"id": "seen", "sensor": "T"}, {"id": "a"}, {"id": "b"}, {"id": "c"}],
        "conductors": [{"between": pair} for pair in (["a", "b"], ["b", "c"], ["c", "a"])],
    }
    with pytest.raises(SpecError, match="nodes: no sensor sees a, b, c: join one of them"):
        load_spec(spec)
    spec["conductors"] = [*spec["conductors"], {"between": ["seen", "c"]}]  # type: ignore[misc]
    assert len(load_spec(spec).nodes) == 4
