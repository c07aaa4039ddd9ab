"""Scenario files: the examples load, and every wrong field is refused in one line that names it."""

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml

from twin_core.errors import SpecError
from twin_core.fem.scenario import load_scenario

EXAMPLES = Path(__file__).parents[3] / "examples" / "scenarios"


def small() -> dict[str, Any]:
    """Return a small valid scenario."""
    return {
        "scenario": "small",
        "mesh_size_m": 0.1,
        "time": {"duration_s": 600, "step_s": 30, "sample_s": 60},
        "regions": [
            {"id": "a", "x_m": [0, 0.1], "y_m": [0, 0.2], "material": "aluminium_6061"},
            {"id": "b", "x_m": [0.1, 0.3], "y_m": [0, 0.2], "material": "copper"},
            {"id": "c", "x_m": [0.5, 0.6], "y_m": [0, 0.2], "material": "g10"},
        ],
        "joints": [{"between": ["a", "b"], "conductance_W_per_m2_K": 50}],
        "boundaries": {"space": {"value_K": 3}},
        "radiators": [{"surface": "a.left", "emissivity": 0.8, "sink": "space"}],
        "forcings": {
            "Q": {"kind": "power", "unit": "W", "signal": {"signal": "constant", "value": 5}},
            "mode": {"kind": "auxiliary", "levels": True, "signal": {"signal": "constant", "value": 1}},
        },
        "loads": [{"forcing": "Q", "place": "b"}],
        "sensors": [{"channel": "T_a", "region": "a"}, {"channel": "T_b", "at_m": [0.2, 0.1]}],
    }


def changed(path: str, value: Any) -> dict[str, Any]:
    """Return the small scenario with the field at a dotted path set to a value."""
    body = copy.deepcopy(small())
    *steps, last = path.split(".")
    place: Any = body
    for step in steps:
        place = place[int(step) if step.isdigit() else step]
    place[int(last) if last.isdigit() else last] = value
    return body


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.yaml")), ids=lambda path: path.name)
def test_examples_load(path: Path) -> None:
    """Every example scenario is valid, and knows its channels."""
    scenario = load_scenario(path)
    assert scenario.channels
    assert {sensor.channel for sensor in scenario.sensors} <= set(scenario.channels)


def test_round_trip_through_yaml(tmp_path: Path) -> None:
    """A dumped scenario loads to the same scenario, from a file and from a mapping."""
    scenario = load_scenario(small())
    file = tmp_path / "small.yaml"
    file.write_text(yaml.safe_dump(scenario.model_dump(mode="json", exclude_none=True)))
    assert load_scenario(file) == scenario
    assert scenario.channels["Q"].unit == "W"
    assert scenario.channels["T_a"].kind == "temperature"


WRONG: list[tuple[str, Any, str]] = [
    ("scenario", "Small Sat", "scenario: String should match"),
    ("seed", -1, "seed: .*greater than or equal to 0"),
    ("mesh_size_m", 0, "mesh_size_m: .*greater than 0"),
    ("mesh_size_m", 1e-6, "mesh_size_m: 1.2e\\+11 cells of 1e-06 m; raise it"),
    ("depth", 1.0, "depth: unknown field"),
    ("time.step_s", 25, "time: step_s \\(25\\) must divide sample_s \\(60\\)"),
    ("time.duration_s", 30, "time: duration_s must hold at least one sample"),
    ("time.duration_s", 1e12, "time: more than five million steps"),
    ("time.jitter_s", 40, "time: jitter_s must stay below half"),
    ("time.missing_fraction", 1.0, "time.missing_fraction: .*less than 1"),
    ("time.start", "yesterday", "time.start: 'yesterday' is not an RFC 3339 instant"),
    ("time.start", "2026-01-01T00:00:00", "time.start: .*names no UTC offset"),
    ("time.scheme", "euler", "time.scheme: .*sdirk2"),
    ("time.gaps", [{"start_s": 5, "stop_s": 1}], "time.gaps\\[0\\]: stop_s must come after"),
    ("time.gaps", [{"start_s": 5, "stop_s": 9, "channel": "T_z"}], "time.gaps\\[0\\].channel: unknown channel 'T_z'"),
    ("regions", [], "regions: .*at least 1 item"),
    ("regions.0.x_m", [0.2, 0.1], "regions\\[0\\].x_m: 0.2 is not below 0.1"),
    ("regions.0.x_m", ["left", 0.1], "regions\\[0\\].x_m\\[0\\]: .*got 'left'"),
    ("regions.0.material", "unobtainium", "regions\\[0\\].material: unknown material 'unobtainium'"),
    ("regions.1.id", "a", "regions\\[1\\].id: 'a' is declared twice"),
    ("regions.2.id", "left", "regions\\[2\\].id: 'left' is the name of an outer edge"),
    ("regions.1.x_m", [0.0, 0.1], "regions: 'a' is covered completely"),
    ("joints.0.between", ["a", "c"], "joints\\[0\\].between: 'a' and 'c' have no side in common; use a strap"),
    ("joints.0.between", ["a", "z"], "joints\\[0\\].between: unknown region 'z'"),
    ("joints.0.between", ["a", "a"], "joints\\[0\\].between: a and a are joined already"),
    ("joints.0.conductance_W_per_m2_K", -1, "joints\\[0\\].conductance_W_per_m2_K: .*greater than or equal to 0"),
    ("straps", [{"between": ["a", "z"], "conductance_W_per_K": 1}], "straps\\[0\\].between: unknown region or outer"),
    (
        "straps",
        [{"between": ["a.front", "c"], "conductance_W_per_K": 1}],
        "straps\\[0\\].between: unknown side 'front'",
    ),
    ("boundaries.space", {}, "boundaries.space: give exactly one of 'value_K', 'forcing'"),
    ("boundaries.space", {"forcing": "Q"}, "boundaries.space.forcing: forcing 'Q' is power, must be temperature"),
    ("radiators.0.surface", "a", "radiators\\[0\\].surface: 'a' is a region; name a side"),
    ("radiators.0.surface", "b.left", "radiators\\[0\\].surface: 'b' has no free side facing left"),
    ("radiators.0.emissivity", 1.2, "radiators\\[0\\].emissivity: .*less than or equal to 1"),
    ("radiators.0.sink", "moon", "radiators\\[0\\].sink: unknown boundary 'moon' \\(known: space\\)"),
    ("forcings.Q.unit", "K", "forcings.Q: .*W or percent"),
    ("forcings.Q.unit", "percent", "forcings.Q: unit percent is not heat"),
    ("forcings.Q.signal.signal", "noise", "forcings.Q.signal: .*'noise'"),
    ("forcings.Q.signal.value", True, "forcings.Q.signal.value: must be a number, not true or false"),
    ("forcings.Q.signal.level", 2, "forcings.Q.signal.level: unknown field"),
    ("forcings.Q.signal", {"signal": "table", "time_s": [0, 0], "values": [1, 2]}, "time_s must strictly increase"),
    ("loads.0.forcing", "mode", "loads\\[0\\].forcing: forcing 'mode' is auxiliary, must be power"),
    ("loads.0.forcing", "P", "loads\\[0\\].forcing: unknown forcing 'P'"),
    ("loads.0.place", "b.left", "loads\\[0\\].place: 'b' has no free side"),
    ("sensors.0.region", "z", "sensors\\[0\\].region: unknown region 'z'"),
    ("sensors.0.at_m", [0.0, 0.0], "sensors\\[0\\]: give exactly one of 'region'"),
    ("sensors.1.at_m", [0.4, 0.1], "sensors\\[1\\].at_m: \\(0.4, 0.1\\) lies in no region"),
    ("sensors.1.channel", "T_a", "sensors\\[1\\].channel: 'T_a' is declared twice"),
    ("sensors.0.noise_std_K", float("nan"), "sensors\\[0\\].noise_std_K: .*finite"),
    ("hidden", [{"effect": "gremlin"}], "hidden\\[0\\]: .*'gremlin'"),
    ("hidden", [{"effect": "constant_heat_load", "node": "z", "Q_W": 1}], "hidden\\[0\\]: node: unknown region 'z'"),
    ("hidden", [{"effect": "constant_heat_load", "node": "a"}], "hidden\\[0\\].Q_W: is missing"),
    (
        "hidden",
        [{"effect": "conductance_step", "nodes": ["a", "c"], "f": 0.5, "time": 60}],
        "hidden\\[0\\]: 'a' and 'c' have no joint or strap",
    ),
    (
        "hidden",
        [{"effect": "emissivity_step", "node": "b", "sink": "space", "f": 0.5, "time": 60}],
        "hidden\\[0\\]: 'b' has no radiator to 'space'",
    ),
    (
        "hidden",
        [{"effect": "sensor_bias", "sensor": "T_a", "b_K": 1, "time": "2026-01-01T00:00:00Z"}],
        "hidden\\[0\\]: time: is a date, but the scenario counts seconds",
    ),
    ("hidden", [{"effect": "input_gain", "channel": "mode", "g": 2}], "channel: forcing 'mode' is auxiliary, must be"),
    (
        "hidden",
        [{"effect": "thermostat_heater", "node": "a", "Q_W": 5, "T_on_K": 290, "T_off_K": 280}],
        "T_on_K \\(290\\) must be below T_off_K",
    ),
]


@pytest.mark.parametrize(("path", "value", "message"), WRONG, ids=[f"{p}-{i}" for i, (p, _, _) in enumerate(WRONG)])
def test_a_wrong_field_is_named_in_one_line(path: str, value: Any, message: str) -> None:
    """The message names the field and says what is wrong."""
    with pytest.raises(SpecError, match=message) as caught:
        load_scenario(changed(path, value))
    assert "\n" not in str(caught.value)


def test_perfect_contact_around_a_joint_is_a_contradiction() -> None:
    """A and B joined, both in perfect contact with C: the joint could not act."""
    body = small()
    body["regions"][2] = {"id": "c", "x_m": [0, 0.3], "y_m": [0.2, 0.3], "material": "g10"}
    with pytest.raises(SpecError, match="'a' and 'b' are in perfect contact through other regions"):
        load_scenario(body)


def test_an_orbit_needs_a_date() -> None:
    """Positions of the Sun exist at dates only."""
    body = small()
    body["forcings"]["Q"]["signal"] = {
        "signal": "orbit_face",
        "elements": {"epoch": "2026-01-01T00:00:00Z", "semi_major_axis_m": 7e6, "inclination_deg": 98},
        "normal": [0, 0, 1],
        "area_m2": 1,
        "absorptance": 0.3,
        "emissivity": 0.8,
    }
    with pytest.raises(SpecError, match=r"forcings.Q.signal: an orbit needs a date; give time.start"):
        load_scenario(body)
    body["time"]["start"] = "2026-01-01T00:00:00Z"
    load_scenario(body)


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "top level must be a mapping"), ("a: [", "line 1: not valid YAML"), ("a: 1\na: 2\n", "'a' stands twice")],
)
def test_a_broken_file_is_named(tmp_path: Path, text: str, message: str) -> None:
    """The message begins with the file."""
    file = tmp_path / "broken.yaml"
    file.write_text(text)
    with pytest.raises(SpecError, match=message) as caught:
        load_scenario(file)
    assert str(caught.value).startswith(str(file))
