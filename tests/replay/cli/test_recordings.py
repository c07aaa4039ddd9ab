"""Both formats hold the same record; foreign recordings find their channels; segments must fit together."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replay.cli.recordings import check_apart, load_record, load_records, save_record
from replay.errors import ReplayError
from replay.mcap_io import write_mcap
from twin_core.errors import TelemetryError
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

EPOCH_NS = 1_767_225_600_000_000_000
UNITS = {"T_a": "degC", "T_b": "K", "Q_a": "W"}


@pytest.fixture
def spec(pair: dict[str, Any]) -> TwinSpec:
    return load_spec(pair)


def example(epoch_ns: int | None, start_s: float = 0.0) -> Record:
    time_s = start_s + np.array([0.0, 1.5, 60.0])
    values = {"T_a": [300.0, 301.0, np.nan], "T_b": [290.0, np.nan, 291.0], "Q_a": [5.0, 6.0, 7.0]}
    return Record(time_s, {name: np.array(column) for name, column in values.items()}, epoch_ns)


@pytest.mark.parametrize("suffix", [".csv", ".mcap"])
@pytest.mark.parametrize("epoch_ns", [None, EPOCH_NS])
def test_round_trip(tmp_path: Path, spec: TwinSpec, suffix: str, epoch_ns: int | None) -> None:
    path = tmp_path / f"a{suffix}"
    original = example(epoch_ns, 0.0 if epoch_ns else 12.0)
    save_record(path, original, UNITS, {"scenario": "x"})
    record = load_record(path, spec)
    assert record.epoch_ns == epoch_ns and record.notices == ()
    np.testing.assert_allclose(record.time_s, original.time_s, rtol=0, atol=1e-9)
    for name, column in original.values.items():
        np.testing.assert_allclose(record.values[name], column, rtol=0, atol=1e-9)


def write(path: Path, columns: dict[str, list[float]], units: dict[str, str]) -> None:
    time_ns = EPOCH_NS + np.arange(2, dtype=np.int64) * 10**9
    write_mcap(path, time_ns, {name: np.array(column) for name, column in columns.items()}, units)


def test_foreign_topics_and_units(tmp_path: Path, spec: TwinSpec) -> None:
    columns = {"/bus/T_a": [300.0, 301.0], "T_b": [20.0, 21.0], "/power/Q_a": [5.0, 6.0], "/gyro": [1.0, 2.0]}
    write(tmp_path / "a.mcap", columns, {"/bus/T_a": "K", "T_b": "degC", "/power/Q_a": "W"})
    record = load_record(tmp_path / "a.mcap", spec)
    np.testing.assert_allclose(record.values["T_a"], [300.0, 301.0])
    np.testing.assert_allclose(record.values["T_b"], [293.15, 294.15])
    assert record.notices and "/gyro" in record.notices[0]


@pytest.mark.parametrize(
    ("columns", "units", "message"),
    [
        ({"T_a": [1, 1], "T_b": [290, 290], "Q_a": [1, 1]}, {"Q_a": "percent"}, "channel 'Q_a' is in percent"),
        ({"T_a": [1, 1], "Q_a": [1, 1]}, {}, "channel 'T_b' of the specification has no column"),
        (
            {"T_a": [1, 1], "T_b": [290, -5], "Q_a": [1, 1]},
            {},
            "sample at 2026-01-01T00:00:01Z: channel 'T_b' is below",
        ),
        ({"gyro": [1, 1]}, {}, "no topic"),
    ],
)
def test_recordings_that_do_not_fit(
    tmp_path: Path, spec: TwinSpec, columns: dict[str, list[float]], units: dict[str, str], message: str
) -> None:
    write(tmp_path / "a.mcap", columns, units)
    with pytest.raises((TelemetryError, ReplayError), match=f"a.mcap: .*{message}"):
        load_record(tmp_path / "a.mcap", spec)


def test_segments_keep_their_order_and_form(tmp_path: Path, spec: TwinSpec) -> None:
    for name, epoch_ns in (("b.csv", EPOCH_NS + 10**12), ("a.mcap", EPOCH_NS), ("c.csv", None)):
        save_record(tmp_path / name, example(epoch_ns), UNITS, {})
    records = load_records([tmp_path / "b.csv", tmp_path / "a.mcap"], spec)
    assert [Path(record.name).name for record in records] == ["b.csv", "a.mcap"]
    with pytest.raises(TelemetryError, match=r"c.csv: counts seconds, .*b.csv is dated"):
        load_records([tmp_path / "b.csv", tmp_path / "c.csv"], spec)


def test_hold_out_must_lie_apart() -> None:
    day = example(EPOCH_NS)
    check_apart([day], [Record(day.time_s, day.values, EPOCH_NS + 61 * 10**9, "next")])
    with pytest.raises(TelemetryError, match="overlaps record in time"):
        check_apart([day], [Record(day.time_s, day.values, EPOCH_NS + 60 * 10**9, "next")])
    check_apart([example(None)], [Record(day.time_s, day.values, None, "next")])
    with pytest.raises(TelemetryError, match="next: is dated, record counts seconds"):
        check_apart([example(None)], [Record(day.time_s, day.values, EPOCH_NS, "next")])
