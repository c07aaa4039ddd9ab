"""Units and instants, against datetime and the published distance of the Sun."""

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin_core.errors import TelemetryError
from twin_core.units import format_instant, from_si, parse_instant_ns, sun_distance_au, to_si

INSTANTS = st.datetimes(datetime(1970, 1, 1), datetime(2199, 12, 31), timezones=st.just(UTC))


def test_celsius_and_back() -> None:
    values = np.array([-273.15, 0.0, 36.6])
    np.testing.assert_allclose(to_si(values, "degC"), [0.0, 273.15, 309.75], rtol=0, atol=1e-12)
    np.testing.assert_allclose(from_si(to_si(values, "degC"), "degC"), values, rtol=0, atol=1e-12)


@pytest.mark.parametrize("unit", ["K", "W", "percent", "deg", None])
def test_other_units_stay(unit: str | None) -> None:
    values = np.array([1.0, np.nan])
    np.testing.assert_array_equal(to_si(values, unit), values)
    np.testing.assert_array_equal(from_si(values, unit), values)


@given(INSTANTS)
def test_instants_round_trip(instant: datetime) -> None:
    unix_ns = (instant - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000
    assert parse_instant_ns(format_instant(unix_ns)) == unix_ns
    assert datetime.fromisoformat(format_instant(unix_ns)) == instant


def test_offsets_name_the_same_instant() -> None:
    instant = datetime(2026, 1, 3, 12, 30, tzinfo=timezone(timedelta(hours=5, minutes=30)))
    assert format_instant(parse_instant_ns(instant.isoformat())) == "2026-01-03T07:00:00Z"


@pytest.mark.parametrize("text", ["", "yesterday", "2026-13-01T00:00:00Z", "2026-01-03T00:00:00"])
def test_what_is_no_instant(text: str) -> None:
    with pytest.raises(TelemetryError, match="2026-01-03T00:00:00Z"):
        parse_instant_ns(text)


@pytest.mark.parametrize(
    ("instant", "distance_au"),
    [
        # Perihelion and aphelion of 2017 as the Astronomical Almanac lists them.
        ("2017-01-04T14:18:00Z", 0.98331),
        ("2017-07-03T20:11:00Z", 1.01668),
    ],
)
def test_sun_distance(instant: str, distance_au: float) -> None:
    # The formula is stated to be good to 1e-4.
    assert sun_distance_au(parse_instant_ns(instant), np.zeros(1))[0] == pytest.approx(distance_au, abs=2e-4)
