"""Bad input: exit code 2, one line on stderr that names file and place, no traceback, nothing left behind."""

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from replay.cli.main import main
from twin_core.errors import SpecError
from twin_core.network.spec_io import load_spec

Edit = Callable[[dict[str, Any]], None]
DELETED = object()


def edit(*path: str | int, to: Any = DELETED) -> Edit:
    """Return a change of one field of a nested document."""

    def change(document: Any) -> None:
        for key in path[:-1]:
            document = document[key]
        if to is DELETED:
            del document[path[-1]]
        else:
            document[path[-1]] = to

    return change


SPECIFICATIONS: list[tuple[Edit, str]] = [
    (edit("twin"), "twin: is missing"),
    (edit("twin", to="Bench Sat"), "twin: is no valid id; begin with a lower-case letter or digit"),
    (edit("twin", to="-sat"), "twin: is no valid id; begin with a lower-case letter or digit"),
    (edit("twin", to="s" * 64), "63 at most"),
    (edit("twin", to=7), "twin: must be text"),
    (edit("colour", to="red"), "colour: unknown field"),
    (edit("channels"), "channels: is missing"),
    (edit("channels", to=["T_a"]), "channels: must be a mapping"),
    (edit("channels", "T_a", to="degC"), "channels.T_a: must be a mapping"),
    (edit("channels", "T_a", "kind", to="temp"), "channels.T_a.kind"),
    (edit("channels", "T_a", "unit", to="F"), "channels.T_a: unit of a temperature channel is K or degC"),
    (edit("channels", "T_a", "noise_std", to=0), "channels.T_a.noise_std: must be greater than 0"),
    (edit("channels", "Q_a", "unit", to="kW"), "channels.Q_a: unit of a power channel is W or percent"),
    (edit("channels", "Q_a", "noise_std", to=1.0), "channels.Q_a: noise_std"),
    (edit("channels", "Q_a", "interpolation", to="cubic"), "channels.Q_a.interpolation"),
    (edit("channels", "Q_a", "levels", to=True), "channels.Q_a: only an auxiliary channel has levels"),
    (edit("nodes", to=[]), "nodes: must hold more entries"),
    (edit("nodes", to={"a": 1}), "nodes: must be a list"),
    (edit("nodes", 0, to="a"), "nodes[0]: must be a mapping"),
    (edit("nodes", 0, "id", to="a b"), "nodes[0].id: is no valid name"),
    (edit("nodes", 1, "id", to="a"), "nodes[1].id: 'a' is declared twice"),
    (edit("nodes", 0, "capacity", to={"guess": 2}), "nodes[0].capacity: unknown field"),
    (edit("nodes", 0, "sensor", to="T_z"), "nodes[0].sensor: unknown channel 'T_z'"),
    (edit("nodes", 0, "sensor", to="Q_a"), "nodes[0].sensor: channel 'Q_a' is power"),
    (edit("nodes", 1, "sensor", to="T_a"), "nodes[1].sensor: 'T_a' already reads node 'a'"),
    (edit("nodes", 0, "capacity_J_per_K", to=5.0), "nodes[0].capacity_J_per_K: write {value: 5} where it is known"),
    (edit("nodes", 0, "capacity_J_per_K", "guess", to=-5), "nodes[0].capacity_J_per_K.guess: must be greater than 0"),
    (edit("nodes", 0, "capacity_J_per_K", "guess", to="big"), "nodes[0].capacity_J_per_K.guess: must be a number"),
    (edit("nodes", 0, "capacity_J_per_K", "guess", to=True), "nodes[0].capacity_J_per_K.guess: must be a number"),
    (edit("nodes", 0, "capacity_J_per_K", to={"value": 1, "guess": 2}), "nodes[0].capacity_J_per_K: give either"),
    (edit("nodes", 0, "capacity_J_per_K", to={"guess": 2, "bounds": [3, 4]}), "guess 2 lies outside its bounds"),
    (edit("nodes", 0, "capacity_J_per_K", to={"bounds": [4, 1]}), "bounds contradict each other"),
    (edit("boundaries", "space", to={}), "boundaries.space: give exactly one of"),
    (edit("boundaries", "space", "value_K", to=-1), "boundaries.space.value_K"),
    (edit("boundaries", "space", to={"channel": "T_z"}), "boundaries.space.channel: unknown channel 'T_z'"),
    (edit("boundaries", "a", to={"value_K": 3}), "boundaries.a: a node has the same id"),
    (edit("conductors", 0, "between", to=["a", "z"]), "conductors[0].between: unknown node or boundary 'z'"),
    (edit("conductors", 0, "between", to=["a", "a"]), "conductors[0].between: joins 'a' to itself"),
    (edit("conductors", 0, "conductance_W_per_K", "guess", to=0), "conductors[0].conductance_W_per_K.guess"),
    (edit("radiators", 0, "emissivity", to=1.2), "radiators[0].emissivity: must be less than or equal to 1"),
    (edit("radiators", 0, "emissivity", to=float("nan")), "radiators[0].emissivity"),
    (edit("radiators", 0, "area_m2"), "radiators[0].area_m2: is missing"),
    (edit("radiators", 0, "sink", to="b"), "radiators[0].sink: unknown boundary 'b'"),
    (edit("loads", 0, "channel", to="T_a"), "loads[0].channel: channel 'T_a' is temperature"),
    (edit("loads", 0, "node", to="z"), "loads[0].node: unknown node 'z'"),
    (edit("loads", 0, "weight", to=2.0), "loads[0].weight"),
    (edit("loads", 0, "table", to={"knots": [1]}), "loads[0].table.knots"),
    (edit("loads", 0, "solar", to="maybe"), "loads[0].solar: must be true or false"),
    (edit("exclude", to=[{"start": "yesterday", "stop": 3}]), "exclude[0].start"),
    (edit("exclude", to=[{"start": 5, "stop": 3}]), "exclude[0]: stop must come after start"),
    (edit("exclude", to=[{"start": 5, "stop": 9}]), "exclude[0].start: is a number of seconds"),
    (edit("criteria", to={"bias": 1}), "criteria.bias: unknown field"),
    (edit("criteria", to={"bias_K": float("inf")}), "criteria.bias_K"),
    (
        edit("criteria", to={"per_sensor": {"Q_a": {"std_K": 1}}}),
        "criteria.per_sensor.Q_a: reads no node (sensors: T_a",
    ),
    (edit("channels", "T_a", "limits", to={}), "channels.T_a.limits: give 'yellow', 'red' or both"),
    (edit("channels", "T_a", "limits", to={"red": [None, None]}), "channels.T_a.limits: red limits nothing"),
    (edit("channels", "T_a", "limits", to={"red": [9, 3]}), "channels.T_a.limits: red limits contradict each other"),
    (
        edit("channels", "T_a", "limits", to={"yellow": [5, 90], "red": [0, 80]}),
        "channels.T_a.limits: the yellow limit 90 lies above the red one 80",
    ),
    (edit("nodes", 0, "capacity_J_per_K", to={"value": 2, "spread": 2}), "spread says how far a guess may be off"),
    (
        edit("nodes", 0, "capacity_J_per_K", to={"guess": 2, "spread": 0.5}),
        "capacity_J_per_K.spread: must be greater than 1",
    ),
    (edit("boundaries", "space", "spread", to=5), "boundaries.space: spread says by how many K"),
    (edit("nodes", 0, "capacity_J_per_K", to={"per_mass": "cp"}), "'mass_kg' what multiplies it; give both"),
    (
        edit("nodes", 0, "capacity_J_per_K", to={"per_mass": "cp", "mass_kg": 2, "guess": 5}),
        "nodes[0].capacity_J_per_K: give either 'per_mass' with 'mass_kg', or 'guess', not both",
    ),
    (
        edit("nodes", 0, "capacity_J_per_K", to={"per_area": "h", "area_m2": 2}),
        "capacity_J_per_K.per_area: unknown field",
    ),
    (
        edit("nodes", 0, "capacity_J_per_K", to={"per_mass": "cp", "mass_kg": 2}),
        "nodes[0].capacity_J_per_K.per_mass: unknown parameter 'cp'; declare it under parameters (known: none)",
    ),
    (edit("parameters", to={"h": {"guess": 5}}), "parameters.h: is used nowhere"),
    (edit("parameters", to={"h": {"guess": -5}}), "parameters.h.guess: must be greater than 0"),
]

TLE = [
    "1 39444U 13066AE  16035.38257241  .00000865  00000-0  11531-3 0  9990",
    "2 39444  97.7004  94.3150 0060634  98.1157 262.6940 14.80829622117779",
]


def orbit(attitude: Any = "nadir", **fields: Any) -> dict[str, Any]:
    return {"tle": TLE, "attitude": attitude, **fields}


def declare_orbit(**rest: Any) -> Edit:
    """Return a change that declares an orbit, and replaces or adds other fields."""

    def change(document: Any) -> None:
        document |= {"orbit": orbit(), **rest}

    return change


_BY_SUN = {"channel": "orbit.sun_px", "node": "a"}
ORBITS: list[tuple[Edit, str]] = [
    (edit("orbit", to={"attitude": "nadir"}), "orbit.tle: is missing"),
    (edit("orbit", to={"tle": TLE}), "orbit.attitude: is missing"),
    (edit("orbit", to=orbit(tle=TLE[:1])), "orbit.tle[1]: is missing"),
    (edit("orbit", to=orbit(tle=TLE[::-1])), "orbit.tle[0]: line 1 must have 69 characters and begin with '1 '"),
    (edit("orbit", to=orbit(tle=[TLE[0], TLE[1][:-1] + "8"])), "orbit.tle[1]: checksum of line 2 is 8, must be 9"),
    (
        edit("orbit", to=orbit(tle=[TLE[0], TLE[1].replace("97.70", "9x.70")])),
        "orbit.tle[1]: inclination (line 2, columns",
    ),
    (edit("orbit", to=orbit(tle=[TLE[0], 7])), "orbit.tle[1]: must be text"),
    (edit("orbit", to=orbit("upside-down")), "orbit.attitude.pointing: must be 'nadir', 'sun' or 'tumbling'"),
    (edit("orbit", to=orbit(["nadir"])), "orbit.attitude: must be a mapping of fields"),
    (edit("orbit", to=orbit({})), "orbit.attitude: give one of nadir, sun, tumbling,"),
    (edit("orbit", to=orbit({"inertial": [1, 1, 0, 0]})), "orbit.attitude.inertial: is no attitude"),
    (edit("orbit", to=orbit({"inertial": [1, 0, 0]})), "orbit.attitude.inertial[3]: is missing"),
    (edit("orbit", to=orbit({"spin_axis": [0, 0, 0]})), "orbit.attitude.spin_axis: must not be (0, 0, 0)"),
    (edit("orbit", to=orbit({"inertial": [1, 0, 0, 0], "frame": "orbit"})), "orbit.attitude: frame belongs to"),
    (edit("orbit", to=orbit({"pointing": "sun", "about": "x"})), "orbit.attitude: about belongs to spin_axis"),
    (
        edit("orbit", to=orbit({"quaternion_channels": ["q0", "q1", "q2", "q3"]})),
        "orbit.attitude.quaternion_channels: unknown channel 'q0'",
    ),
    (
        edit("orbit", to=orbit({"quaternion_channels": ["T_a", "T_a", "T_a", "T_a"]})),
        "orbit.attitude.quaternion_channels: channel 'T_a' is temperature, must be auxiliary",
    ),
    (edit("orbit", to=orbit(albedo=1.5)), "orbit.albedo: must be less than or equal to 1"),
    (edit("orbit", to=orbit(earth_infrared_W_per_m2=-1)), "orbit.earth_infrared_W_per_m2: must be greater"),
    (edit("orbit", to=orbit(height_km=500)), "orbit.height_km: unknown field"),
    (edit("loads", 0, to=_BY_SUN), "loads[0].channel: unknown channel 'orbit.sun_px'; declare the orbit"),
    (declare_orbit(loads=[{**_BY_SUN, "channel": "orbit.sun_up"}]), "'orbit.sun_up'; correct its name (known:"),
    (declare_orbit(loads=[{**_BY_SUN, "channel": "orbit.sun_mean"}]), "loads[0].channel: unknown channel"),
    (declare_orbit(loads=[{**_BY_SUN, "solar": True}]), "loads[0].solar: 'orbit.sun_px' follows the Sun's distance"),
    (declare_orbit(loads=[{**_BY_SUN, "table": {"knots": [0, 1]}}]), "loads[0].table: 'orbit.sun_px' is heat already"),
    (
        declare_orbit(loads=[{**_BY_SUN, "channel": "orbit.eclipse"}]),
        "loads[0].table: auxiliary channel 'orbit.eclipse'",
    ),
]
"""Changes that are wrong about an orbit."""

TEXTS: list[tuple[str, str, str]] = [
    ("spec.yaml", "", "the top level must be a mapping"),
    ("spec.yaml", "- a\n- b\n", "the top level must be a mapping"),
    ("spec.yaml", "twin: x\nnodes: [a\n", "line 3: not valid YAML"),
    ("spec.yaml", "twin: x\ntwin: y\n", "line 2: 'twin' stands twice"),
    ("spec.yaml", "[" * 3000, "nested too deeply"),
    ("spec.yaml", "twin: !!python/object:os.system {}\n", "line 1: not valid YAML"),
    ("spec.json", '{"twin": "x",\n', "line 2: not valid JSON"),
    ("spec.json", '{"twin": "x", "twin": "y"}', "'twin' stands twice"),
    ("spec.json", '{"twin": ' + "9" * 5000 + "}", "too many digits"),
]

HEAD = "time,T_a,T_b,Q_a\n"
ROW = "2026-01-01T00:0{}:00Z,20,293,5\n"
TELEMETRY: list[tuple[str | bytes, str]] = [
    ("", "is empty"),
    (HEAD, "has a header but no rows"),
    (b"\x89PNG\r\n\x1a\n\x00\x00\xff", "row 1: not text in UTF-8"),
    (HEAD.encode() + b"2026-01-01T00:00:00Z,1\x00,2,3\n", "row 2: holds a NUL byte"),
    (HEAD.replace(",", ";") + ROW.format(0).replace(",", ";"), "row 1: columns must be separated by commas"),
    ("stamp,T_a,T_b,Q_a\n" + ROW.format(0), "row 1: the first column is 'stamp'"),
    ("time,T_a,T_a,Q_a\n" + ROW.format(0), "row 1: column 'T_a' stands twice"),
    ("time,T_a,Q_a\n2026-01-01T00:00:00Z,20,5\n", "channel 'T_b' of the specification has no column"),
    (HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,20,293\n", "row 3: has 3 fields, the header has 4"),
    (HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,20,293,5,6\n", "row 3: has 5 fields, the header has 4"),
    (HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,warm,293,5\n", "row 3: column 'T_a' holds 'warm'"),
    (HEAD + "\n\n" + ROW.format(0) + "2026-01-01T00:01:00Z,20,293,on\n", "row 5: column 'Q_a' holds 'on'"),
    (
        HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,inf,293,5\n",
        "row 3: column 'T_a' holds 'inf', which is not a finite number; correct it, or leave the cell empty where a sample is",
    ),
    (
        HEAD.replace("time", "time_s") + "inf,20,293,5\n",
        "column 'time_s' holds 'inf', which is not a finite number; correct it\n",
    ),
    (HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,nan,293,5\n", "row 3: column 'T_a' holds 'nan'"),
    (HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,20,1e999,5\n", "row 3: column 'T_b' holds '1e999'"),
    (HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,-300,293,5\n", "row 3: column 'T_a' holds -300 degC, which is below"),
    (
        HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,20,-1,5\n",
        "row 3: column 'T_b' holds -1 K, which is below absolute",
    ),
    (HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,9998,293,5\n", "row 3: column 'T_a' holds 9998 degC, which is above"),
    (HEAD + ROW.format(0) + "2026-01-01T00:01:00Z,20,293,1e30\n", "row 3: column 'Q_a'"),
    (HEAD + ROW.format(1) + ROW.format(0), "row 3: column 'time' is earlier than the row before"),
    (HEAD + "2026-01-01T00:00:00,20,293,5\n", "row 2: column 'time' holds '2026-01-01T00:00:00', which names no UTC"),
    (HEAD + "yesterday,20,293,5\n", "row 2: column 'time' holds 'yesterday', which is not an RFC 3339 instant"),
    (HEAD + "2026-02-30T00:00:00Z,20,293,5\n", "row 2: column 'time' holds '2026-02-30T00:00:00Z', which is no date"),
    (HEAD + "1767225600,20,293,5\n", "or name the column time_s"),
    (HEAD + ",20,293,5\n", "row 2: column 'time' is empty"),
    (HEAD.replace("time", "time_s") + "0,20,293,5\n,20,293,5\n", "row 3: column 'time_s' is empty"),
    (HEAD.replace("time", "time_s") + "soon,20,293,5\n", "row 2: column 'time_s' holds 'soon'"),
    (HEAD + '2026-01-01T00:00:00Z,"20,293,5\n', "row 2: "),
    (HEAD + ROW.format(0) + ROW.format(1), "fewer than three usable samples of T_a, T_b; give a longer record"),
    (HEAD + "".join(map(ROW.format, range(4))), "8 readings are too few to determine 5 unknowns"),
    (
        HEAD + "".join(f"2026-01-01T00:00:00Z,{20 + k},293,5\n" for k in range(10)),
        "all 10 rows have the same time, 2026-01-01T00:00:00Z; give each row the time of its own sample",
    ),
    (
        HEAD.replace("time", "time_s") + "".join(f"7,2{k},293,5\n" for k in range(3)),
        "column 'time_s': all 3 rows have the same time, 7; give",
    ),
    (HEAD + "2026-01-01T00:00:00Z,20,,5\n2026-01-01T00:01:00Z,20,,5\n", "channel 'T_b' has no samples"),
    (HEAD + "2026-01-01T00:00:00Z,20,0,5\n2026-01-01T00:01:00Z,20,0,5\n", "all its samples are masked (sentinel)"),
    (HEAD + "2026-01-01T00:00:00Z,20,293,\n2026-01-01T00:01:00Z,20,293,\n", "channel 'Q_a' has no samples"),
]

ARGUMENTS: list[tuple[str, str]] = [
    ("frobnicate", "No such command 'frobnicate'"),
    ("calibrate", "Missing option '--spec'"),
    ("calibrate --spec spec.yaml --out x.json", "Missing option '--telemetry'"),
    ("calibrate --spec absent.yaml --telemetry data.csv --out x.json", "absent.yaml: cannot be read"),
    ("calibrate --spec spec.yaml --telemetry absent.csv --out x.json", "absent.csv: cannot be read"),
    ("calibrate --spec spec.yaml --telemetry data.txt --out x.json", "data.txt: the name must end in"),
    ("calibrate --spec spec.yaml --telemetry data.csv --out x.txt", "x.txt: the name must end in"),
    ("calibrate --spec spec.yaml --telemetry data.csv --out no/x.json", "no/x.json: cannot be written"),
    (
        "calibrate --spec spec.yaml --telemetry data.csv --method magic --out x.json",
        "'magic' is not one of 'second-order', 'neural-ode'",
    ),
    ("calibrate --spec spec.yaml --telemetry data.csv --epochs 9 --out x.json", "belong to --method neural-ode"),
    (
        "calibrate --spec spec.yaml --telemetry data.csv --deadline 0 --out x.json",
        "'0' is no positive number of seconds",
    ),
    ("calibrate --spec spec.yaml --telemetry data.csv data.csv --out x.json", "data.csv: is named twice"),
    ("calibrate --spec spec.yaml --telemetry data.csv undated.csv --out x.json", "counts seconds, data.csv is dated"),
    ("calibrate --spec spec.yaml --telemetry broken.mcap --out x.json", "broken.mcap: not a complete MCAP file"),
    ("calibrate --spec . --telemetry data.csv --out x.json", "cannot be read (Is a directory)"),
    ("simulate --scenario absent.yaml --out x.csv", "absent.yaml: cannot be read"),
    ("simulate --scenario spec.yaml --out x.csv", "spec.yaml: "),
    ("simulate --scenario spec.yaml --out x.png", "x.png: the name must end in .csv or .mcap"),
    ("close-loop --spec spec.yaml --telemetry data.csv --out x --holdout 1.5", "--holdout must be between 0 and 1"),
    ("close-loop --spec spec.yaml --telemetry data.csv --out x --holdout half", "--holdout"),
    (
        "close-loop --spec spec.yaml --telemetry data.csv --out x --holdout 0.9999",
        "data.csv: a hold-out of 0.9999 leaves 1 sample to train on, 10 are needed; choose another hold-out, or give a longer",
    ),
    (
        "close-loop --spec spec.yaml --telemetry data.csv --out x --holdout 0.01",
        "data.csv: a hold-out of 0.01 leaves 1 sample to predict",
    ),
    (
        "close-loop --spec spec.yaml --telemetry lone.csv --out x",
        "lone.csv: 1 sample in all, too few for a hold-out: 10 to train on and 3 to predict are needed; give a longer record",
    ),
    (
        "close-loop --spec spec.yaml --telemetry ten.csv --out x --holdout 0.1",
        "ten.csv: 10 samples in all, too few for a hold-out: 10 to train on and 3 to predict are needed; give a longer record",
    ),
    (
        "close-loop --spec spec.yaml --telemetry data.csv --holdout-telemetry ten.csv --out x",
        "ten.csv: a burn-in of 10 of its 10 samples leaves fewer than two to score; give a longer hold-out",
    ),
    ("close-loop --spec spec.yaml --telemetry data.csv --out x --burn-in 9", "--burn-in belongs to"),
    ("close-loop --spec spec.yaml --telemetry data.csv --out data.csv", "--out data.csv is a file"),
    ("close-loop --spec spec.yaml --telemetry data.csv --out x --false-alarm-rate 2", "--false-alarm-rate must be"),
    (
        "close-loop --spec spec.yaml --telemetry data.csv --holdout-telemetry data.csv --out x",
        "data.csv: is both telemetry and hold-out",
    ),
    (
        "close-loop --spec spec.yaml --telemetry data.csv --holdout-telemetry b.csv --holdout 0.2 --out x",
        "--holdout and --holdout-telemetry exclude each other",
    ),
    (
        "close-loop --spec spec.yaml --telemetry data.csv --holdout-telemetry copy.csv --out x",
        "copy.csv: overlaps data.csv in time",
    ),
    ("forecast --model absent.json --telemetry data.csv --horizon 60 --out x.csv", "absent.json: cannot be read"),
    ("forecast --model spec.json --telemetry data.csv --horizon 60 --out x.csv", "spec.json: format: not a model"),
    ("forecast --model model.json --telemetry data.csv --horizon soon --out x.csv", "--horizon"),
    ("forecast --model model.json --telemetry data.csv --horizon -60 --out x.csv", "'--horizon': '-60' is no positive"),
    ("forecast --model model.json --telemetry data.csv --horizon inf --out x.csv", "'--horizon': 'inf' is no positive"),
    (
        "forecast --model model.json --telemetry data.csv --horizon 60 --step 0 --out x.csv",
        "'--step': '0' is no positive",
    ),
    (
        "forecast --model model.json --telemetry data.csv --horizon 60 --step 2min --out x.csv",
        "'--step': must be positive and at most the horizon of 60 s; it is 120 s",
    ),
    (
        "forecast --model model.json --telemetry data.csv --horizon 59 --out x.csv",
        "'--step': must be positive and at most the horizon of 59 s; it is 60 s; where none is given it is the sampling interval",
    ),
    (
        "forecast --model model.json --telemetry data.csv --horizon 1d --step 0.001 --out x.csv",
        "'--step': 86400000 points asked for",
    ),
    (
        "forecast --model model.json --telemetry data.csv --horizon 9999999w --step 9999w --out x.csv",
        "'--horizon': 6.048e+12 s are",
    ),
    ("forecast --model model.json --telemetry data.csv copy.csv --horizon 60 --out x.csv", "copy.csv: a forecast"),
    ("forecast --model model.json --telemetry data.csv --horizon 60 --out x.txt", "x.txt: the name must end in"),
    ("forecast --model model.json --telemetry one.csv --horizon 60 --out x.csv", "one.csv: holds one sample"),
    ("replay absent.mcap --url http://127.0.0.1:9 --twin x", "absent.mcap: cannot be read"),
    ("replay broken.mcap --url http://127.0.0.1:9 --twin x", "broken.mcap: not a complete MCAP file"),
    ("replay broken.mcap --url localhost --twin x", "--url must begin with http://"),
    ("replay broken.mcap --url http://127.0.0.1:9 --twin x --rate -1", "--rate must be a positive number or max"),
    ("replay broken.mcap --url http://127.0.0.1:9 --twin x --map a", "--map must read TOPIC=CHANNEL"),
    ("serve --host 0.0.0.0", "TWIN_API_KEYS"),
    ("serve --port 99999", "TWIN_PORT"),
    ("demo --effect gremlins --out x", "unknown effect 'gremlins'"),
    ("demo --seed -1 --out x", "--seed"),
    ("demo --out data.csv", "--out data.csv is a file"),
]

MODELS: list[tuple[Edit, str]] = [
    (edit("format", to="something else"), "format: not a model file"),
    (edit("values"), "values: is missing"),
    (edit("values", "C:a"), "values.C:a: is missing"),
    (edit("values", "C:a", to="big"), "values.C:a: must be a number; the model file is damaged"),
    (edit("values", "C:a", to=float("nan")), "values.C:a: is not a finite number"),
    (edit("covariance", to=[[1.0]]), "covariance: must be a square of numbers"),
    (edit("noise_K", "T_a"), "T_a: is missing"),
    (edit("spec", "twin", to="!"), "twin: is no valid id"),
    (edit("spec", to=None), "spec: must be a mapping; the model file is damaged"),
    (edit("spec", to="benchsat"), "spec: must be a mapping; the model file is damaged"),
    (edit("values", to="many"), "values: must be a mapping; the model file is damaged"),
    (edit("free_names", to="C:a"), "free_names: must be a list; the model file is damaged"),
    (edit("max_step_s", to="long"), "max_step_s: must be a number; the model file is damaged"),
    (edit("noise_K", "T_a", to=[1]), "noise_K.T_a: must be a number; the model file is damaged"),
    (edit("summary", to=3), "summary: must be a mapping; the model file is damaged"),
    (edit("table_knots", to=[3]), "table_knots[0]: must be a mapping; the model file is damaged"),
    (edit("effects", to=[{"effect": "gremlins", "where": {"node": "a"}}]), "gremlins"),
]

PLANS: list[tuple[str, str]] = [
    ("time,Q_z\n2026-01-01T00:40:00Z,5\n", "plan.csv: has columns that the specification does not name: Q_z"),
    ("time,T_a\n2026-01-01T00:40:00Z,5\n", "plan.csv: plans no input"),
    ("time_s,Q_a\n5,5\n", "plan.csv: must write time in the form of data.csv"),
    ("time,Q_a\n2026-01-01T00:40:00Z,\n", "plan.csv: plans no value of Q_a"),
    ("time,Q_a\n2026-01-01T00:20:00Z,5\n", "plan.csv: ends at 2026-01-01T00:20:00Z, before the forecast begins"),
    ("time,Q_a\n2026-01-02T00:00:00Z,5\n", "plan.csv: begins at 2026-01-02T00:00:00Z, after the forecast ends"),
    ("time,Q_a\n2026-01-01T00:40:00Z,much\n", "plan.csv: row 2: column 'Q_a' holds 'much'"),
]


@pytest.fixture(scope="session")
def model_text(
    tmp_path_factory: pytest.TempPathFactory, pair_declared: dict[str, Any], pair_telemetry: Callable[[int], str]
) -> str:
    """The text of a good model file."""
    folder = tmp_path_factory.mktemp("model")
    (folder / "spec.yaml").write_text(yaml.safe_dump(pair_declared))
    (folder / "data.csv").write_text(pair_telemetry(200))
    argv = f"calibrate --spec {folder}/spec.yaml --telemetry {folder}/data.csv --out {folder}/model.json --json"
    assert main(argv.split()) == 0
    return (folder / "model.json").read_text()


@pytest.fixture
def desk(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    pair: dict[str, Any],
    pair_telemetry: Callable[[int], str],
    model_text: str,
    capsys: pytest.CaptureFixture[str],
) -> Path:
    """A folder with a good specification, good telemetry and a few bad files, as the working directory."""
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(pair))
    (tmp_path / "spec.json").write_text(json.dumps(pair))
    (tmp_path / "model.json").write_text(model_text)
    (tmp_path / "data.csv").write_text(pair_telemetry(40))
    (tmp_path / "data.txt").write_text(pair_telemetry(40))
    (tmp_path / "copy.csv").write_text(pair_telemetry(40))
    (tmp_path / "lone.csv").write_text("".join(pair_telemetry(40).splitlines(keepends=True)[:2]))
    late = pair_telemetry(50).splitlines(keepends=True)
    (tmp_path / "ten.csv").write_text(late[0] + "".join(late[-10:]))
    (tmp_path / "undated.csv").write_text("time_s,T_a,T_b,Q_a\n0,20,293,5\n")
    (tmp_path / "one.csv").write_text(pair_telemetry(1))
    (tmp_path / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(40))
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    return tmp_path


def assert_refused(argv: Sequence[str], desk: Path, capsys: pytest.CaptureFixture[str], *expected: str) -> None:
    """Assert that the command line refuses its input as it must."""
    before = sorted(path.name for path in desk.iterdir())
    code = main(argv)
    printed = capsys.readouterr()
    assert code == 2, printed.err
    assert printed.err.count("\n") == 1 and printed.err.startswith("twin: ")
    assert "Traceback" not in printed.err and printed.out == ""
    for text in expected:
        assert text in printed.err
    assert sorted(path.name for path in desk.iterdir()) == before


@pytest.mark.parametrize(
    ("change", "expected"), SPECIFICATIONS + ORBITS, ids=[case[1] for case in SPECIFICATIONS + ORBITS]
)
def test_specification(
    change: Edit, expected: str, desk: Path, pair: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    change(pair)
    (desk / "spec.yaml").write_text(yaml.safe_dump(pair))
    argv = ["calibrate", "--spec", "spec.yaml", "--telemetry", "data.csv", "--out", "model.json"]
    assert_refused(argv, desk, capsys, expected)


def test_a_shared_unknown_has_one_unit(desk: Path, pair: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    pair["parameters"] = {"x": {"guess": 5.0}, "y": {"bounds": [1, 2]}}
    pair["nodes"][0]["capacity_J_per_K"] = {"per_mass": "x", "mass_kg": 2.0}
    pair["nodes"][1]["capacity_J_per_K"] = {"per_mass": "y", "mass_kg": 2.0}
    pair["conductors"][0]["conductance_W_per_K"] = {"per_area": "x", "area_m2": 2.0}
    (desk / "spec.yaml").write_text(yaml.safe_dump(pair))
    argv = ["calibrate", "--spec", "spec.yaml", "--telemetry", "data.csv", "--out", "model.json"]
    wrong = "conductors[0].conductance_W_per_K.per_area: 'x' is in J/kg/K elsewhere and would be in W/m2/K here"
    assert_refused(argv, desk, capsys, f"spec.yaml: {wrong}", "; also: parameters.y: give a 'guess' that is calibrated")


def test_everything_that_is_wrong_is_told_at_once(
    desk: Path, pair: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """Broken references, all of them; and faults of single fields, of which one that may be two types is told once."""
    argv = ["calibrate", "--spec", "spec.yaml", "--telemetry", "data.csv", "--out", "model.json"]
    for changes in (
        [SPECIFICATIONS[i] for i, (_, text) in enumerate(SPECIFICATIONS) if "unknown channel 'T_z'" in text],
        [
            (edit("colour", to="red"), "colour: unknown field"),
            (edit("nodes", 0, "sensor", to=5), "nodes[0].sensor"),
            (edit("nodes", 0, "capacity_J_per_K", "guess", to=-5), "nodes[0].capacity_J_per_K.guess: must be greater"),
            (edit("radiators", 0, "area_m2"), "radiators[0].area_m2: is missing"),
        ],
    ):
        wrong = yaml.safe_load(yaml.safe_dump(pair))
        for change, _ in changes:
            change(wrong)
        (desk / "spec.yaml").write_text(yaml.safe_dump(wrong))
        assert_refused(argv, desk, capsys, *(text for _, text in changes))
        with pytest.raises(SpecError) as caught:
            load_spec(wrong)
        assert str(caught.value) == caught.value.problems[0]
        assert len(set(caught.value.problems)) == len(caught.value.problems) >= len(changes)


@pytest.mark.parametrize(("name", "text", "expected"), TEXTS, ids=[f"{n}-{e}" for n, _, e in TEXTS])
def test_specification_file(
    name: str, text: str, expected: str, desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (desk / name).write_text(text)
    assert_refused(
        ["close-loop", "--spec", name, "--telemetry", "data.csv", "--out", "loop"], desk, capsys, name, expected
    )


@pytest.mark.parametrize(("content", "expected"), TELEMETRY, ids=[case[1] for case in TELEMETRY])
def test_telemetry(content: str | bytes, expected: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (desk / "data.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    argv = ["calibrate", "--spec", "spec.yaml", "--telemetry", "data.csv", "--out", "model.json"]
    assert_refused(argv, desk, capsys, "data.csv", expected)


def test_orbit_without_dates(desk: Path, pair: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    (desk / "spec.yaml").write_text(yaml.safe_dump({**pair, "orbit": orbit()}))
    rows = "".join(f"{60 * k},20,293,5\n" for k in range(60))
    (desk / "data.csv").write_text(HEAD.replace("time", "time_s") + rows)
    for command in ("calibrate --out model.json", "close-loop --out loop"):
        name, *rest = command.split()
        argv = [name, "--spec", "spec.yaml", "--telemetry", "data.csv", *rest]
        assert_refused(
            argv, desk, capsys, "data.csv: the orbit needs dates; give a 'time' column in RFC 3339, not 'time_s'"
        )


@pytest.mark.parametrize(("line", "expected"), ARGUMENTS, ids=[case[1] for case in ARGUMENTS])
def test_arguments(line: str, expected: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert_refused(line.split(), desk, capsys, expected)


@pytest.mark.parametrize(("change", "expected"), MODELS, ids=[case[1] for case in MODELS])
def test_model_file(change: Edit, expected: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = json.loads((desk / "model.json").read_text())
    change(model)
    (desk / "model.json").write_text(json.dumps(model))
    line = "forecast --model model.json --telemetry data.csv --horizon 600 --out x.csv"
    assert_refused(line.split(), desk, capsys, "model.json: ", expected)


@pytest.mark.parametrize(("text", "expected"), PLANS, ids=[case[1] for case in PLANS])
def test_plan(text: str, expected: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (desk / "plan.csv").write_text(text)
    line = "forecast --model model.json --telemetry data.csv --horizon 600 --plan plan.csv --out x.json"
    assert_refused(line.split(), desk, capsys, expected)


@pytest.mark.parametrize(
    "line", [ARGUMENTS[0][0], ARGUMENTS[3][0], ARGUMENTS[4][0]], ids=["usage", "spec", "telemetry"]
)
def test_real_process(line: str, desk: Path) -> None:
    command = [sys.executable, "-m", "replay.cli.main", *line.split()]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert run.returncode == 2
    assert run.stdout == "" and run.stderr.count("\n") == 1 and run.stderr.startswith("twin: ")
