"""MCAP round trip, foreign files and broken ones."""

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from replay.errors import RecordingError
from replay.mcap_io import read_mcap, read_mcap_segments, write_mcap
from replay.mcap_writer import McapWriter

START_NS = 1_767_225_600_123_456_000


def columns() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    time_ns = START_NS + np.arange(5, dtype=np.int64) * 10_000_000_000
    return time_ns, {
        "T_px": np.array([290.0, np.nan, 291.5, 1e-9, -3.25]),
        "Q_px": np.array([np.nan, 12.0, np.nan, np.nan, 40.0]),
    }


def test_round_trip_keeps_every_bit(tmp_path: Path) -> None:
    time_ns, values = columns()
    write_mcap(tmp_path / "a.mcap", time_ns, values, {"T_px": "K"}, {"twin": "benchsat"})
    back = read_mcap(tmp_path / "a.mcap")
    np.testing.assert_array_equal(back.time_ns, time_ns)
    for name, column in values.items():
        np.testing.assert_array_equal(back.columns[name], column)
    assert back.units == {"T_px": "K"}
    assert back.metadata == {"twin": "benchsat"}


def test_reference_library_sees_one_json_topic_per_channel(tmp_path: Path) -> None:
    time_ns, values = columns()
    declared = b'{"twin": "benchsat"}'
    write_mcap(tmp_path / "a.mcap", time_ns, values, {"T_px": "K"}, {}, {"specification.json": declared})
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        (attached,) = reader.iter_attachments()
        messages = list(reader.iter_messages())
    assert summary is not None
    assert sorted(channel.topic for channel in summary.channels.values()) == ["Q_px", "T_px"]
    assert {channel.message_encoding for channel in summary.channels.values()} == {"json"}
    assert {schema.encoding for schema in summary.schemas.values()} == {"jsonschema"}
    assert (attached.name, attached.media_type, attached.data) == ("specification.json", "application/json", declared)
    names = [schema.name for schema in summary.schemas.values()]
    assert len(set(names)) == len(names) == 2
    first_schema, first_channel, first = messages[0]
    assert json.loads(first_schema.data)["properties"]["value"]["unit"] == "K"
    assert json.loads(first_schema.data)["properties"]["value"]["type"] == "number"
    assert (first_channel.topic, first.log_time, json.loads(first.data)) == ("T_px", START_NS, {"value": 290.0})
    assert len(messages) == 6  # four finite temperatures, two powers; missing samples write nothing


def test_foreign_file_with_several_fields_per_message(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/thermal", "json", 0)
        for second, temperature in ((2, 291.0), (1, 290.0)):
            data = json.dumps({"T_px": temperature, "ok": True, "name": "x"}).encode()
            writer.add_message(channel, second * 10**9, data, second * 10**9)
        writer.finish()
    back = read_mcap(path)
    assert list(back.columns) == ["/thermal.T_px"]
    np.testing.assert_array_equal(back.columns["/thermal.T_px"], [290.0, 291.0])


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda data: b"", "is empty"),
        (lambda data: data[: len(data) // 2], "not a complete MCAP file"),
        (lambda data: data[:-9], "not a complete MCAP file"),
        (lambda data: b"time,T_px\n1,2\n" * 50, "not a complete MCAP file"),
        (lambda data: data[:4], "not a complete MCAP file"),
    ],
    ids=["empty", "half", "no-footer", "csv", "four-bytes"],
)
def test_broken_files_are_named_in_one_line(tmp_path: Path, make, reason: str) -> None:
    time_ns, values = columns()
    write_mcap(tmp_path / "good.mcap", time_ns, values)
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(make((tmp_path / "good.mcap").read_bytes()))
    with pytest.raises(RecordingError, match=reason) as caught:
        read_mcap(bad)
    assert "bad.mcap" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        read_mcap(tmp_path / "none.mcap")


def test_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    time_ns, values = columns()
    write_mcap(tmp_path / "a.mcap", time_ns, values)
    before = (tmp_path / "a.mcap").read_bytes()
    with pytest.raises(RecordingError, match="row 1: channel 'T_px' is infinite"):
        write_mcap(tmp_path / "a.mcap", time_ns, {"T_px": np.full(5, np.inf)})
    with pytest.raises(RecordingError, match="does not increase"):
        write_mcap(tmp_path / "a.mcap", time_ns[::-1].copy(), values)
    assert (tmp_path / "a.mcap").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def _written(path: Path, samples: list[tuple[int, float]]) -> Path:
    with McapWriter(path, ["T"]) as writer:
        for instant_s, value in samples:
            writer.add("T", instant_s * 10**9, value)
    return path


def test_a_clock_that_jumps_back_begins_a_segment(tmp_path: Path) -> None:
    path = _written(
        tmp_path / "a.mcap", [(t, t + 0.5) for t in range(100, 140)] + [(t, float(t)) for t in range(90, 130)]
    )
    first, second = read_mcap_segments(path)
    np.testing.assert_array_equal(first.time_ns, np.arange(100, 140) * 10**9)
    np.testing.assert_array_equal(second.columns["T"], np.arange(90.0, 130.0))
    (whole,) = read_mcap_segments(_written(tmp_path / "b.mcap", [(5, 5.0), (4, 4.0), (6, 6.0)]))
    np.testing.assert_array_equal(whole.columns["T"], [4.0, 5.0, 6.0])


def test_repeated_instants_are_counted(tmp_path: Path) -> None:
    recording = read_mcap(_written(tmp_path / "a.mcap", [(5, 5.0), (5, 5.0), (5, 7.0), (6, 6.0)]))
    np.testing.assert_array_equal(recording.columns["T"], [5.0, 6.0])
    assert [notice.split(";")[0] for notice in recording.notices] == [
        "1 sample repeats the instant and the value of an earlier one",
        "1 sample repeats the instant of an earlier one with another value",
    ]
