"""Instants against the standard library, for every spelling and both parsers."""

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service import instants
from service.errors import BadField
from service.instants import format_instant, format_instants, parse_instant, parse_instants, parse_parameter

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
moments = st.datetimes(datetime(1970, 1, 2), datetime(2199, 12, 30))
zones = st.integers(-14 * 60, 14 * 60).map(lambda m: timezone(timedelta(minutes=m)))


def micros(moment: datetime) -> int:
    return (moment - EPOCH) // timedelta(microseconds=1)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(moments, zones), min_size=1, max_size=5))
def test_offsets_and_fractions(pairs: list) -> None:
    aware = [moment.replace(tzinfo=zone) for moment, zone in pairs]
    assert parse_instants([moment.isoformat() for moment in aware]).tolist() == [micros(m) for m in aware]


@pytest.mark.parametrize("timespec", ["seconds", "milliseconds", "microseconds"])
def test_block_parser_equals_the_standard_library(timespec: str) -> None:
    generator = np.random.default_rng(0)
    aware = [EPOCH + timedelta(microseconds=int(x)) for x in generator.integers(0, 7 * 10**15, size=500)]
    texts = [moment.isoformat(timespec=timespec).replace("+00:00", "Z") for moment in aware]
    expected = [micros(datetime.fromisoformat(text)) for text in texts]
    assert parse_instants(texts).tolist() == expected
    assert [parse_instant(text, "t") for text in texts[:20]] == expected[:20]


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 7_258_118_399_999_999))
def test_round_trips(instant: int) -> None:
    assert parse_instant(format_instant(instant), "t") == instant
    if instant < 2**32 * 10**6:  # from 2106 on two doubles of a second lie almost a microsecond apart
        assert parse_instants([instant / 1e6]).tolist() == [instant]


def test_fractions_beyond_the_microsecond_are_rounded() -> None:
    assert parse_instants(["1970-01-01T00:00:00.0000015Z", "1970-01-01T00:00:00.0000004Z"]).tolist() == [2, 0]


def test_microseconds_only_where_there_are_any() -> None:
    assert format_instants(np.array([0, 1_500_000])) == ["1970-01-01T00:00:00Z", "1970-01-01T00:00:01.500000Z"]


@pytest.mark.parametrize(
    ("text", "instant"),
    [
        ("2016-12-31T23:59:60Z", "2017-01-01T00:00:00Z"),
        ("2016-12-31T23:59:60.250Z", "2017-01-01T00:00:00.250000Z"),
        ("2015-06-30T18:59:60.5-05:00", "2015-07-01T00:00:00.500000Z"),
    ],
)
def test_a_leap_second_counts_as_the_second_after_it(text: str, instant: str) -> None:
    assert format_instants(parse_instants([text] * 50)) == [instant] * 50


@pytest.mark.parametrize(
    "text", ["1767225600", "2026-01-01T00:00:00Z", "2026-01-01T01:00:00+01:00", "2026-01-01T01:00:00 01:00"]
)
def test_parameters_take_both_forms_and_a_plus_that_became_a_blank(text: str) -> None:
    assert parse_parameter(text, "start") == 1_767_225_600_000_000


WRONG = [
    "",
    "now",
    "2026-01-01",
    "2026-01-01T00:00Z",
    "20260101T000000Z",
    "2026-13-01T00:00:00Z",
    "2026-02-29T00:00:00Z",
]
WRONG += [
    "2026-01-01T25:00:00Z",
    "2026-01-01T00:60:00Z",
    "2026-01-01T00:00:60Z",
    "2016-12-31T23:59:61Z",
    "2016-12-30T23:59:60Z",
    "2016-12-31T22:59:60Z",
    "2016-12-31T23:59:60+01:00",
    "2026-01-01T00:00:00",
    "２026-01-01T00:00:00Z",
]


@pytest.mark.parametrize("text", WRONG)
@pytest.mark.parametrize("count", [1, 50], ids=["one", "block"])
def test_what_is_no_instant(text: str, count: int) -> None:
    good = ["2026-01-01T00:00:00Z"] * (count - 1)
    with pytest.raises(BadField) as caught:
        parse_instants([*good, text])
    assert caught.value.errors[0][0] == f"time[{count - 1}]"


@pytest.mark.parametrize(("behind_s", "kept"), [(-420.0, True), (300.0, True), (0.2, False)])
def test_a_process_keeps_to_the_clock_that_counts(monkeypatch: pytest.MonkeyPatch, behind_s: float, kept: bool) -> None:
    """A difference that the time until the answer may explain changes nothing."""
    monkeypatch.setattr(instants, "_behind_us", 0)
    monkeypatch.setattr(instants.time, "time_ns", lambda: 1_700_000_000_000_000_000)
    own_us, asked_ns, answered_ns = 1_700_000_000_000_000, 1_699_999_999_000_000_000, 1_700_000_001_000_000_000
    instants.keep_to(own_us + round(1e6 * behind_s), asked_ns, answered_ns)
    assert instants.now_us() == own_us + (round(1e6 * behind_s) if kept else 0)
