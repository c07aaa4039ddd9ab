"""Telemetry files: what is read is what was meant, in SI, and what is written is read back."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twin_core.errors import TelemetryError, TwinError
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record
from twin_core.telemetry_csv import read_csv, read_segments, write_csv


@pytest.fixture
def spec(pair: dict[str, Any]) -> TwinSpec:
    return load_spec(pair)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "a.csv"
    path.write_text(text)
    return path


def test_dated_rows_in_si(tmp_path: Path, spec: TwinSpec) -> None:
    text = "time,Q_a,T_b,T_a\n2026-01-03T00:00:00Z,5,290,20\n2026-01-03T00:00:30.5Z,,291,-10.5\n"
    record = read_csv(written(tmp_path, text), spec)
    assert record.epoch_ns == int(datetime(2026, 1, 3, tzinfo=UTC).timestamp()) * 10**9
    np.testing.assert_array_equal(record.time_s, [0.0, 30.5])
    np.testing.assert_allclose(record.values["T_a"], [293.15, 262.65], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(record.values["T_b"], [290.0, 291.0])
    np.testing.assert_array_equal(record.values["Q_a"], [5.0, np.nan])
    assert record.notices == ()


def test_seconds_stay_as_they_are(tmp_path: Path, spec: TwinSpec) -> None:
    record = read_csv(written(tmp_path, "time_s,T_a,T_b,Q_a\n-5,20,290,1\n7.25,20,290,1\n"), spec)
    assert record.epoch_ns is None
    np.testing.assert_array_equal(record.time_s, [-5.0, 7.25])


@pytest.mark.parametrize(
    "instant",
    ["2026-01-03T02:00:00+02:00", "2026-01-02T19:00:00-05:00", "2026-01-03 00:00:00Z", "2026-01-03t00:00:00.000000z"],
)
def test_spellings_of_one_instant(tmp_path: Path, spec: TwinSpec, instant: str) -> None:
    record = read_csv(written(tmp_path, f"time,T_a,T_b,Q_a\n{instant},20,290,1\n"), spec)
    assert record.present(0.0) == "2026-01-03T00:00:00Z"


def test_undeclared_columns_are_named_and_ignored(tmp_path: Path, spec: TwinSpec) -> None:
    text = "time_s,T_a,junk,T_b,Q_a,note\n0,20,not a number,290,1,hello\n"
    record = read_csv(written(tmp_path, text), spec)
    assert set(record.values) == {"T_a", "T_b", "Q_a"}
    assert len(record.notices) == 1 and "junk, note" in record.notices[0]


def test_required_channels_may_be_fewer(tmp_path: Path, spec: TwinSpec) -> None:
    path = written(tmp_path, "time_s,Q_a\n0,1\n")
    assert set(read_csv(path, spec, required=()).values) == {"Q_a"}
    with pytest.raises(TelemetryError, match="channel 'T_a' of the specification has no column"):
        read_csv(path, spec)


@pytest.mark.parametrize("epoch_ns", [None, 1_767_225_600_123_456_000])
def test_round_trip(tmp_path: Path, spec: TwinSpec, epoch_ns: int | None) -> None:
    rng = np.random.default_rng(4)
    time_s = np.concatenate([[0.0], np.cumsum(rng.integers(1, 10**7, 50) / 1e6)])
    values = {name: rng.uniform(200.0, 400.0, 51) for name in ("T_a", "T_b", "Q_a")}
    values["T_b"][7] = np.nan
    write_csv(tmp_path / "a.csv", Record(time_s, values, epoch_ns), spec)
    record = read_csv(tmp_path / "a.csv", spec)
    assert record.epoch_ns == epoch_ns
    np.testing.assert_allclose(record.time_s, time_s, rtol=0, atol=1e-9)
    for name, column in values.items():
        # degC are rounded to a nanokelvin on the way out; everything else is exact.
        np.testing.assert_allclose(record.values[name], column, rtol=0, atol=1e-9 if name == "T_a" else 1e-13)


def test_written_in_the_channels_own_units(tmp_path: Path, spec: TwinSpec) -> None:
    record = Record(np.array([0.0]), {"T_a": np.array([298.4]), "Q_a": np.array([5.5])})
    write_csv(tmp_path / "a.csv", record, spec)
    assert (tmp_path / "a.csv").read_text().splitlines() == ["time_s,T_a,Q_a", "0.0,25.25,5.5"]


def test_nothing_is_left_where_it_cannot_be_written(tmp_path: Path, spec: TwinSpec) -> None:
    record = Record(np.array([0.0]), {"Q_a": np.array([5.5])})
    with pytest.raises(TwinError, match="cannot be written"):
        write_csv(tmp_path / "absent" / "a.csv", record, spec)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "instant",
    [
        "2026-121T06:00:00Z",
        "2026:121:06:00:00",
        "2026-121T06:00:00.000Z",
        "2026:121:08:00:00+02:00",
        "2026-05-01T06:00:00Z",
    ],
)
def test_a_day_of_the_year_is_a_date(tmp_path: Path, spec: TwinSpec, instant: str) -> None:
    """Day 121 of a common year: 31 + 28 + 31 + 30 days lie before the first of May."""
    record = read_csv(written(tmp_path, f"time,T_a,T_b,Q_a\n{instant},20,290,1\n"), spec)
    assert record.present(0.0) == "2026-05-01T06:00:00Z"


@pytest.mark.parametrize("instant", ["2026-366T06:00:00Z", "2026-000T06:00:00Z", "2026:12:06:00:00"])
def test_a_day_that_the_year_lacks_is_refused(tmp_path: Path, spec: TwinSpec, instant: str) -> None:
    with pytest.raises(TelemetryError, match="row 2: column 'time' holds"):
        read_csv(written(tmp_path, f"time,T_a,T_b,Q_a\n{instant},20,290,1\n"), spec)


def test_repeated_instants_are_dropped_and_counted(tmp_path: Path, spec: TwinSpec) -> None:
    rows = "0,20,290,1\n0,20,290,1\n5,21,290,1\n5,22,290,1\n5,,290,1\n9,23,290,1\n"
    record = read_csv(written(tmp_path, f"time_s,T_a,T_b,Q_a\n{rows}"), spec)
    np.testing.assert_array_equal(record.time_s, [0.0, 5.0, 9.0])
    np.testing.assert_allclose(record.values["T_a"], [293.15, 294.15, 296.15])
    assert "1 row repeats the instant and the values" in record.notices[0]
    assert "2 rows repeat the instant of the row before with other values; the first stays" in record.notices[1]


def test_a_clock_that_jumps_back_begins_a_segment(tmp_path: Path, spec: TwinSpec) -> None:
    time_s = [*range(30), *range(10, 15), *range(5, 45)]
    rows = "".join(f"{t},{20 + 0.1 * row},290,1\n" for row, t in enumerate(time_s))
    path = written(tmp_path, f"time_s,T_a,T_b,Q_a\n{rows}")
    first, second = read_segments(path, spec)
    np.testing.assert_array_equal(first.time_s, np.arange(30.0))
    np.testing.assert_array_equal(second.time_s, np.arange(5.0, 45.0))
    assert second.values["T_a"][0] == pytest.approx(293.15 + 3.5)
    assert (
        "jumps back 2 times, first in row 32" in first.notices[0]
        and "5 rows between jumps are left out" in first.notices[0]
    )
    assert second.notices == ()
    with pytest.raises(TelemetryError, match="its clock jumps back to 5"):
        read_csv(path, spec)


def test_markers_of_missing_samples_pass_the_door(tmp_path: Path, spec: TwinSpec) -> None:
    """They are masked later, where the whole record is seen; what is no marker is refused as ever."""
    record = read_csv(written(tmp_path, "time_s,T_a,T_b,Q_a\n0,-999,290,1\n1,20,0,1\n"), spec)
    assert record.values["T_a"][0] == pytest.approx(-999 + 273.15) and record.values["T_b"][1] == 0.0
    with pytest.raises(TelemetryError, match="holds -998 degC, which is below absolute zero"):
        read_csv(written(tmp_path, "time_s,T_a,T_b,Q_a\n0,-998,290,1\n"), spec)
