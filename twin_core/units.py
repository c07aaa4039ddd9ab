"""The only place where a number changes its unit: SI inside, the channel's own unit at the edges."""

import re
from datetime import UTC, date, datetime, timedelta
from functools import lru_cache

import numpy as np

from twin_core._typing import FloatArray
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.errors import TelemetryError

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

J2000_NS = 946_728_000_000_000_000
"""Unix nanoseconds of J2000.0, 2000-01-01 12:00 (Julian day 2451545.0)."""


_DAY_OF_YEAR = re.compile(r"(\d{4})[-:](\d{3})[Tt: ](\d\d:\d\d:\d\d(?:\.\d{1,9})?)([Zz]|[+-]\d\d:\d\d)?", re.ASCII)


def to_si(values: FloatArray, unit: str | None) -> FloatArray:
    """Return ``values`` in SI: degC becomes K, every other unit stays as it is."""
    return values + ZERO_CELSIUS_K if unit == "degC" else values


def from_si(values: FloatArray, unit: str | None) -> FloatArray:
    """Return SI ``values`` in the channel's ``unit``."""
    return values - ZERO_CELSIUS_K if unit == "degC" else values


def calendar_instant(text: str) -> str:
    """Return a day-of-year time (``2026-121T06:00:00Z``, ``2026:121:06:00:00``) as RFC 3339; any other text as it is.

    Ground systems write day-of-year times in UTC, with or without saying so. A day that the year lacks stays as it is.
    """
    match = _DAY_OF_YEAR.fullmatch(text)
    if match is None:
        return text
    day = _calendar_day(int(match[1]), int(match[2]))
    return text if day is None else f"{day}T{match[3]}{match[4] or 'Z'}"


@lru_cache(maxsize=1024)
def _calendar_day(year: int, day_of_year: int) -> str | None:
    if year < 1:
        return None
    try:
        day = date(year, 1, 1) + timedelta(days=day_of_year - 1)
    except OverflowError:
        return None
    return day.isoformat() if day.year == year else None


def parse_instant_ns(text: str) -> int:
    """Return unix nanoseconds (rounded to microseconds) of an RFC 3339 instant such as ``2026-01-03T00:00:00Z``.

    Raises
    ------
    TelemetryError
        If the text is not an instant or names no UTC offset.
    """
    try:
        instant = datetime.fromisoformat(calendar_instant(text.strip()))
    except ValueError as error:
        raise TelemetryError(f"'{text}' is not an RFC 3339 instant; write it like 2026-01-03T00:00:00Z") from error
    if instant.tzinfo is None:
        raise TelemetryError(f"'{text}' names no UTC offset; write it like 2026-01-03T00:00:00Z")
    return (instant - _EPOCH) // timedelta(microseconds=1) * 1000


def format_instant(unix_ns: int) -> str:
    """Return unix nanoseconds as RFC 3339 UTC, with microseconds only where there are any."""
    instant = _EPOCH + timedelta(microseconds=round(unix_ns / 1000))
    return instant.isoformat(timespec="microseconds" if instant.microsecond else "seconds").replace("+00:00", "Z")


def sun_distance_au(unix_ns: int, time_s: FloatArray) -> FloatArray:
    """Return the Sun-Earth distance in astronomical units, to about 1e-4.

    Parameters
    ----------
    unix_ns
        Instant of ``time_s = 0`` in unix nanoseconds.
    time_s
        Seconds since then, any shape.

    Notes
    -----
    Low-precision formula of the Astronomical Almanac, section C: g = 357.528 deg + 0.9856003 n,
    R = 1.00014 - 0.01671 cos g - 0.00014 cos 2g, n in days from J2000.0 (valid 1950 to 2050).
    """
    days = (unix_ns - J2000_NS) / 86_400e9 + np.asarray(time_s) / 86_400.0
    mean_anomaly = np.radians(357.528 + 0.9856003 * days)
    return 1.00014 - 0.01671 * np.cos(mean_anomaly) - 0.00014 * np.cos(2.0 * mean_anomaly)
