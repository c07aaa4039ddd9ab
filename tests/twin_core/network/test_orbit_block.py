"""The orbit block: every spelling of an attitude survives being written down, and means what it says."""

import json
from typing import Any

import pytest

from tests.test_bad_input import TLE
from twin_core.network.orbit_block import OrbitBlock
from twin_core.network.spec_io import dump_spec, load_spec
from twin_core.orbit.attitude import FACES, Held, Spinning, Tumbling

SPELLINGS: list[tuple[Any, Any]] = [
    ("nadir", Held("orbit")),
    ("sun", Held("sun")),
    ("tumbling", Tumbling()),
    ({"pointing": "nadir"}, Held("orbit")),
    ({"inertial": [0.5, 0.5, 0.5, 0.5]}, Held("inertial", (0.5, 0.5, 0.5, 0.5))),
    ({"spin_axis": [0, 1, 2]}, Spinning("inertial", (0.0, 1.0, 2.0), "z")),
    ({"spin_axis": [0, 1, 0], "frame": "sun", "about": "x"}, Spinning("sun", (0.0, 1.0, 0.0), "x")),
]


def declared(attitude: Any, **fields: Any) -> dict[str, Any]:
    return {
        "twin": "sat",
        "channels": {"T": {"kind": "temperature", "unit": "K"}}
        | {f"q{i}": {"kind": "auxiliary", "unit": ""} for i in range(4)},
        "nodes": [{"id": "a", "sensor": "T"}],
        "orbit": {"tle": TLE, "attitude": attitude, **fields},
    }


def block(attitude: Any, **fields: Any) -> OrbitBlock:
    found = load_spec(declared(attitude, **fields)).orbit
    assert found is not None
    return found


@pytest.mark.parametrize(("spelling", "attitude"), SPELLINGS)
def test_every_spelling_of_an_attitude(spelling: Any, attitude: Any) -> None:
    spec = load_spec(declared(spelling))
    again = load_spec(json.loads(json.dumps(dump_spec(spec))))
    assert again == spec and hash(again.orbit) == hash(spec.orbit)
    assert block(spelling).environment().attitude == attitude


def test_a_pointing_is_written_as_it_was_read() -> None:
    assert dump_spec(load_spec(declared({"pointing": "sun"})))["orbit"] == {"tle": TLE, "attitude": "sun"}


def test_quaternions_of_channels() -> None:
    spec = load_spec(declared({"quaternion_channels": ["q0", "q1", "q2", "q3"], "frame": "orbit"}))
    assert spec.attitude_channels == ("q0", "q1", "q2", "q3")
    assert set(spec.attitude_channels) <= set(spec.used_channels)
    assert load_spec(dump_spec(spec)) == spec


def test_channels_of_the_orbit_are_inputs_but_no_telemetry() -> None:
    """Nobody has to send them, and no sensor can have their names."""
    spec = load_spec(declared("nadir"))
    assert len(spec.orbit_channels) == 3 * len(FACES) + 2
    assert not set(spec.orbit_channels) & (set(spec.used_channels) | spec.driving_channels)
    assert spec.inputs["orbit.sun_px"].kind == "power" and spec.inputs["orbit.sun_px"].unit == "W/m2"
    assert spec.inputs["orbit.beta"].kind == "auxiliary" and spec.inputs["T"] is spec.channels["T"]
    assert load_spec({**declared("nadir"), "orbit": None}).orbit_channels == {}


def test_what_the_earth_sends_is_declared() -> None:
    told = block("tumbling", albedo=0, earth_infrared_W_per_m2=200).environment()
    assert (told.albedo, told.infrared_W_per_m2) == (0.0, 200.0)
    assumed = block("tumbling").environment()
    assert (assumed.albedo, assumed.infrared_W_per_m2) == (0.30, 237.0)


def test_spaces_after_a_line_do_not_matter() -> None:
    spec = load_spec({**declared("sun"), "orbit": {"tle": [f"{line}  " for line in TLE], "attitude": "sun"}})
    assert spec.orbit is not None and spec.orbit.tle == tuple(TLE)


def test_a_name_of_the_orbit_is_taken_only_where_there_is_one() -> None:
    """A recording may bring channels of that name itself."""
    own = {"orbit.sun_px": {"kind": "power", "unit": "W"}}
    plain = {key: value for key, value in declared("nadir").items() if key != "orbit"}
    assert load_spec({**plain, "channels": {**plain["channels"], **own}}).orbit_channels == {}
    with pytest.raises(Exception, match=r"channels\.orbit\.sun_px: comes from the orbit"):
        load_spec({**declared("nadir"), "channels": {**plain["channels"], **own}})
