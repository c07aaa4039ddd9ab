"""Instants on the wire (RFC 3339 or unix seconds) <-> integer microseconds since 1970, whole arrays at a time."""

import re
import time
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import BadField

Instants = NDArray[np.int64]

FIRST_US = 0
LAST_US = 7_258_118_400_000_000 - 1
"""The last microsecond before 2200-01-01: later times are mistaken units, such as milliseconds."""

_LAST_S = float(LAST_US // 1_000_000)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_EPOCH_UTC = datetime(1970, 1, 1)
_RFC3339 = re.compile(r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:\.(\d{1,18}))?([Zz]|[+-]\d\d:\d\d)", re.ASCII)
_FORM = "write RFC 3339 such as 2026-01-03T00:00:00Z, or unix seconds"
_NUMBERS = (float, int)
_BLOCK = 32
"""From here on the vectorised parser is the faster one."""


def parse_instants(values: Sequence[Any], field: str = "time") -> Instants:
    """Return microseconds since 1970, (n_times,), of strings and numbers in any mixture.

    Raises
    ------
    BadField
        Naming the first element that is no instant or lies outside 1970 to 2199.
    """
    if len(values) == 1 and type(values[0]) in _NUMBERS and 0.0 <= values[0] < _LAST_S:
        return np.array([round(values[0] * 1e6)], dtype=np.int64)
    kinds = set(map(type, values))
    if kinds <= {float, int}:
        seconds = np.array(values, dtype=np.float64)
        if ((seconds >= 0.0) & (seconds < _LAST_S)).all():
            return np.rint(seconds * 1e6).astype(np.int64)
        instants = _from_seconds(seconds, field)
    else:
        block = _parse_block(values) if kinds == {str} and len(values) >= _BLOCK else None
        instants = block if block is not None else _parse_each(values, field)
    wrong = (instants < FIRST_US) | (instants > LAST_US)
    if wrong.any():
        index = int(np.argmax(wrong))
        raise BadField(f"{field}[{index}]", f"{_show(values[index])} is out of range, must lie in 1970 to 2199 UTC")
    return instants


def parse_instant(value: Any, field: str) -> int:
    """Return microseconds since 1970 of one instant; BadField names ``field``."""
    try:
        return int(parse_instants([value], field)[0])
    except BadField as error:
        raise BadField(field, error.errors[0][1]) from None


def parse_parameter(text: str, field: str) -> int:
    """Return microseconds since 1970 of a query parameter, where unix seconds arrive as text."""
    try:
        number = float(text)
    except ValueError:
        return parse_instant(text.replace(" ", "+"), field)  # an unescaped '+' of an offset arrives as a blank
    return parse_instant(number, field)


def _show(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _from_seconds(seconds: NDArray[np.float64], field: str) -> Instants:
    if not np.isfinite(seconds).all():
        raise BadField(f"{field}[{int(np.argmin(np.isfinite(seconds)))}]", "is not a finite number")
    return np.rint(seconds.clip(-1e12, 1e12) * 1e6).astype(np.int64)


def _parse_each(values: Sequence[Any], field: str) -> Instants:
    instants = np.empty(len(values), dtype=np.int64)
    for index, value in enumerate(values):
        try:
            instants[index] = _parse_one(value)
        except (ValueError, OverflowError):
            raise BadField(f"{field}[{index}]", f"{_show(value)} is not a time; {_FORM}") from None
    return instants


def _parse_one(value: Any) -> int:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return round(min(max(value, -1e12), 1e12) * 1e6)
    match = _RFC3339.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        raise ValueError
    date, clock, fraction, offset = match.groups()
    is_leap = clock.endswith(":60")
    clock = clock[:-2] + "59" if is_leap else clock
    whole = datetime.fromisoformat(f"{date}T{clock}{'+00:00' if offset in 'Zz' else offset}")
    if is_leap:
        whole = _after_leap_second(whole)
    micros = round(int(fraction) * 10 ** (6 - len(fraction))) if fraction else 0
    return (whole - _EPOCH) // timedelta(microseconds=1) + micros


def _after_leap_second(before: datetime) -> datetime:
    """Return the second after a leap second, which stands for it: unix time has none, and only months end with one."""
    after = (before + timedelta(seconds=1)).astimezone(UTC)
    if (after.day, after.hour, after.minute) != (1, 0, 0):
        raise ValueError
    return after


_LENGTHS = {20: 0, 24: 3, 27: 6}
_MARKS = {4: b"-", 7: b"-", 10: b"T", 13: b":", 16: b":"}


def _parse_block(values: Sequence[str]) -> Instants | None:
    """Parse equally long ``YYYY-MM-DDThh:mm:ss[.fff[fff]]Z`` at once; None where the slow way must decide."""
    length = len(values[0])
    text = "".join(values)
    if length not in _LENGTHS or not text.isascii() or set(map(len, values)) != {length}:
        return None
    grid = np.frombuffer(text.encode(), dtype=np.uint8).reshape(len(values), length)
    marks = {**_MARKS, length - 1: b"Z"} | ({19: b"."} if length > 20 else {})
    digits = [i for i in range(length) if i not in marks]
    if any((grid[:, i] != mark[0]).any() for i, mark in marks.items()) or (grid[:, digits] - 48 > 9).any():
        return None
    return _assemble(grid.astype(np.int64) - 48, _LENGTHS[length])


def _assemble(digit: Instants, n_decimals: int) -> Instants | None:
    def number(start: int, stop: int) -> Instants:
        return digit[:, start:stop] @ (10 ** np.arange(stop - start - 1, -1, -1))

    year, month, day = number(0, 4), number(5, 7), number(8, 10)
    hour, minute, second = number(11, 13), number(14, 16), number(17, 19)
    months = ((year - 1970) * 12 + month - 1).astype("datetime64[M]")
    dates = months.astype("datetime64[D]") + (day - 1)
    valid = (month >= 1) & (month <= 12) & (day >= 1) & (dates.astype("datetime64[M]") == months)
    if not (valid & (hour < 24) & (minute < 60) & (second < 60)).all():
        return None
    seconds = dates.astype(np.int64) * 86_400 + hour * 3600 + minute * 60 + second
    fraction = number(20, 20 + n_decimals) * 10 ** (6 - n_decimals) if n_decimals else 0
    return seconds * 1_000_000 + fraction


def format_instants(instants: Instants) -> list[str]:
    """Return RFC 3339 UTC, with microseconds only where there are any."""
    stamps = instants.astype("datetime64[us]")
    texts = np.datetime_as_string(stamps, unit="s")
    fractional = instants % 1_000_000 != 0
    if fractional.any():
        texts = np.where(fractional, np.datetime_as_string(stamps, unit="us"), texts)
    return [f"{text}Z" for text in texts.tolist()]


def format_instant(instant: int) -> str:
    """Return one instant as RFC 3339 UTC."""
    return f"{(_EPOCH_UTC + timedelta(microseconds=instant)).isoformat()}Z"


AGREEING_US = 1_000_000
"""Clocks that differ by less agree: what is late or ahead of time is so by seconds at least."""

_behind_us = 0
"""How far this machine's clock is behind the one that counts, see :func:`keep_to`."""


def now_us() -> int:
    """Return the wall clock in microseconds since 1970."""
    return time.time_ns() // 1000 + _behind_us


def keep_to(clock_us: int, asked_ns: int, answered_ns: int) -> None:
    """Keep to another clock from now on: several processes must agree on what is late and what is ahead of time.

    Parameters
    ----------
    clock_us
        What it showed, between the two instants of ``time.time_ns`` at which it was asked and answered. A difference that
        so long an answer may explain, or of clocks that agree, is left as it is.
    """
    global _behind_us
    behind_us = clock_us - (asked_ns + answered_ns) // 2000
    if abs(behind_us - _behind_us) > max((answered_ns - asked_ns) // 1000, AGREEING_US):
        _behind_us = behind_us


_UNITS = (("d", 86_400.0), ("h", 3600.0), ("min", 60.0))


def in_words(seconds: float) -> str:
    """Return a length of time as an operator says it: ``2 h 40 min``, ``3 d 4 h``, ``12 s``."""
    for (name, length), (next_name, next_length) in pairwise((*_UNITS, ("s", 1.0))):
        if round(seconds / next_length) * next_length >= length:
            whole, rest = divmod(round(seconds / next_length), round(length / next_length))
            return f"{whole} {name} {rest} {next_name}" if rest else f"{whole} {name}"
    return f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.2g} s"
