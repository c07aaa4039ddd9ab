"""The record: what it refuses, and how its time is told."""

import numpy as np
import pytest

from twin_core.errors import TelemetryError
from twin_core.telemetry import Record, cut_at_gaps

EPOCH_NS = 1_767_225_600_000_000_000


def record(times: list[float], epoch_ns: int | None = None) -> Record:
    time_s = np.array(times, dtype=np.float64)
    return Record(time_s, {"T": time_s + 300.0}, epoch_ns, "day.csv")


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([], "holds no samples"),
        ([0.0, np.nan], "row 2: time is not finite"),
        ([0.0, 2.0, 1.0], "row 3: time does not increase"),
        ([0.0, 0.0], "row 2: time does not increase"),
    ],
)
def test_time_axis(times: list[float], message: str) -> None:
    with pytest.raises(TelemetryError, match=f"day.csv: {message}"):
        record(times)


def test_shapes_must_agree() -> None:
    with pytest.raises(TelemetryError, match="channel 'T' has 2 samples, time has 3"):
        Record(np.arange(3.0), {"T": np.zeros(2)}, None, "day.csv")


def test_missing_channel_is_named_with_those_present() -> None:
    with pytest.raises(TelemetryError, match=r"channel 'Q' is missing.*add its samples.*there are T"):
        record([0.0]).channel("Q")


def test_between_is_half_open() -> None:
    part = record([0.0, 1.0, 2.0, 3.0]).between(1.0, 3.0)
    assert part.time_s.tolist() == [1.0, 2.0]
    assert part.values["T"].tolist() == [301.0, 302.0]
    with pytest.raises(TelemetryError, match="holds no samples"):
        part.between(5.0, 6.0)


def test_dated_time_in_both_forms() -> None:
    dated = record([0.0, 90.0], EPOCH_NS)
    assert dated.present(90.0) == "2026-01-01T00:01:30Z"
    assert dated.locate_s("2026-01-01T00:01:30Z") == 90.0


def test_undated_time_is_a_number() -> None:
    assert record([5.0]).present(5.0) == 5.0
    with pytest.raises(TelemetryError, match="is a date, the record counts seconds"):
        record([5.0]).locate_s("2026-01-01T00:00:00Z")


def test_an_instant_is_one_number_in_every_dated_record() -> None:
    instant_ns = 1_767_312_000_000_000_000
    early = Record(np.array([0.0, 600.0]), {}, instant_ns)
    late = Record(np.array([-600.0, 0.0]), {}, instant_ns + 600_000_000_000)
    np.testing.assert_array_equal(early.clock_s, [1_767_312_000.0, 1_767_312_600.0])
    np.testing.assert_array_equal(early.clock_s, late.clock_s)
    np.testing.assert_array_equal(Record(np.array([5.0, 6.0]), {}).clock_s, [5.0, 6.0])


def test_a_record_is_cut_at_long_gaps_and_inputs_hold_across_them() -> None:
    time_s = np.array([0.0, 1.0, 2.0, 50.0, 51.0, 200.0])
    values = {"Q": np.array([5.0, 7.0, np.nan, np.nan, 8.0, np.nan]), "T": np.full(6, np.nan)}
    record = Record(time_s, values, None, "day.csv")
    assert record.parts(148.999, {"Q"})[0].time_s.tolist() == time_s[:5].tolist()
    assert record.parts(149.0, {"Q"}) == [record]
    parts = record.parts(40.0, {"Q"})
    assert [part.time_s.tolist() for part in parts] == [[0.0, 1.0, 2.0], [50.0, 51.0], [200.0]]
    np.testing.assert_array_equal(np.concatenate([part.values["Q"] for part in parts]), [5, 7, np.nan, 7, 8, 8])
    assert all(np.isnan(part.values["T"]).all() for part in parts)
    assert np.isnan(values["Q"][3])  # the record itself stays as it is


def test_scraps_between_gaps_are_left_out_where_there_is_more() -> None:
    long, scrap = np.arange(30.0), np.array([1e9])
    assert [r.time_s.size for r in cut_at_gaps([record([*long, *scrap, *(2e9 + long)])], set())] == [30, 30]
    assert [r.time_s.size for r in cut_at_gaps([record([0.0, 1.0, 2.0, *scrap])], set())] == [3]
    untouched = [record([*long]), record([5.0])]
    assert cut_at_gaps(untouched, set()) == untouched
