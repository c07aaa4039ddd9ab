"""Times of files in the time scale that they are in -> unix nanoseconds. Which scale that is, the user says; nobody guesses.

TAI - UTC in whole seconds: IERS Bulletin C. GPS = TAI - 19 s (IS-GPS-200), TT = TAI + 32.184 s (IAU 1991).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from replay.bridges.errors import BadTimeError, BridgeError
from replay.wording import counted

IntArray = NDArray[np.int64]
NS = 1_000_000_000
_STEPS = (
    "1972-01-01 1972-07-01 1973-01-01 1974-01-01 1975-01-01 1976-01-01 1977-01-01 1978-01-01 1979-01-01 1980-01-01 "
    "1981-07-01 1982-07-01 1983-07-01 1985-07-01 1988-01-01 1990-01-01 1991-01-01 1992-07-01 1993-07-01 1994-07-01 "
    "1996-01-01 1997-07-01 1999-01-01 2006-01-01 2009-01-01 2012-07-01 2015-07-01 2017-01-01"
).split()
STEPS_NS: IntArray = np.array(_STEPS, dtype="datetime64[ns]").astype(np.int64)
"""Unix nanoseconds from which on TAI - UTC is 10, 11, ... seconds."""
TAI_LESS_UTC_NS: IntArray = (10 + np.arange(STEPS_NS.size, dtype=np.int64)) * NS
KNOWN_UNTIL = "2026-06-30"
"""No leap second up to here was announced after the last one above; behind it that is assumed, and told."""

TAI_LESS_SCALE_NS = {"tai": 0, "gps": 19 * NS, "tt": -32_184_000_000}
"""What to add to a reading of these uniform scales to have TAI."""
SCALES = ("utc", *TAI_LESS_SCALE_NS)
EPOCHS = {
    "unix": ("utc", "1970-01-01"),
    "gps": ("gps", "1980-01-06"),
    "tai": ("tai", "1958-01-01"),
    "j2000": ("tt", "2000-01-01T12:00:00"),
}
"""Epochs by name: the scale in which they are stated, and their reading on it."""
UNITS_NS = {"s": NS, "ms": 1_000_000, "us": 1_000, "ns": 1}
EARLIEST_NS = int(STEPS_NS[0])
LATEST_NS = int(np.datetime64("2200-01-01", "ns").astype(np.int64))

_TEXT = re.compile(r"(\d{4})[-:](\d\d-\d\d|\d{3})[T :](\d\d:\d\d:)(\d\d)(?:\.(\d{1,9})\d*)?\s*(Z|UTC|[+-]\d\d:?\d\d)?")


@dataclass(frozen=True)
class Stated:
    """What the user states of the times of a file; None where he states nothing."""

    scale: str | None = None
    epoch: str | None = None
    unit: str = "s"


@dataclass(frozen=True)
class Instants:
    """Unix nanoseconds, (n_times,), and what is to be told of them."""

    unix_ns: IntArray
    notices: tuple[str, ...] = ()


def from_texts(texts: Sequence[str], stated: Stated, name: str) -> Instants:
    """Return the instants of calendar times.

    Raises
    ------
    BridgeError
        Naming the row, if one is no time, states no zone while the user states no scale, or states UTC while he says otherwise.
    """
    readings = np.empty(len(texts), dtype=np.int64)
    leaps = 0
    for row, text in enumerate(texts):
        match = _TEXT.fullmatch(text.strip())
        if match is None:
            raise BadTimeError(name, row, f"'{text[:40]}' is no time such as 2026-03-01T00:00:00Z")
        zone = match[6]
        if zone is None and stated.scale is None:
            raise BadTimeError(name, row, f"'{text}' states no zone; say with --time-scale which scale it is in")
        if zone is not None and stated.scale not in (None, "utc"):
            raise BadTimeError(name, row, f"'{text}' is UTC by its zone, --time-scale says {stated.scale}")
        readings[row], leap = _reading(match, name, row)
        leaps += leap
    notices = [_in_leap_seconds(name, leaps)] if leaps else []
    scale = stated.scale or "utc"
    if leaps and scale != "utc":
        raise BridgeError(f"{name}: a second 60 in {scale}, which has none")
    return _finish(readings, scale, name, notices)


def _in_leap_seconds(name: str, times: int) -> str:
    found = counted(times, "time within a leap second counts", "times within leap seconds count")
    return f"{name}: {found} as the second after it"


def _reading(match: re.Match[str], name: str, row: int) -> tuple[int, bool]:
    """Return what a calendar time reads, in nanoseconds since 1970 on its own scale, and whether it is in a leap second."""
    year, day, clock, second, fraction, zone = match.groups()
    is_leap = second == "60"
    try:
        head = f"{year} {day} {clock}{'59' if is_leap else second}"
        when = datetime.strptime(head, "%Y %j %H:%M:%S" if len(day) == 3 else "%Y %m-%d %H:%M:%S")
    except ValueError as error:
        raise BadTimeError(name, row, f"{match[0]} is on no calendar") from error
    if zone is not None and zone[0] in "+-":
        minutes = 60 * int(zone[1:3]) + int(zone[-2:])
        when -= timedelta(minutes=minutes if zone[0] == "+" else -minutes)
    whole = (when - datetime(1970, 1, 1)) // timedelta(seconds=1) + is_leap
    if is_leap and (whole * NS not in STEPS_NS):
        raise BadTimeError(name, row, f"there was no leap second at {match[0]}")
    return whole * NS + int((fraction or "").ljust(9, "0")), is_leap


def from_numbers(values: NDArray[np.float64] | IntArray, stated: Stated, name: str) -> Instants:
    """Return the instants of counts since an epoch; BridgeError if epoch or scale is not stated or one leads nowhere."""
    if stated.epoch is None:
        raise BridgeError(
            f"{name}: times are numbers; say with --epoch what they count from ({', '.join(EPOCHS)} or a time)"
        )
    if stated.unit not in UNITS_NS:
        raise BridgeError(f"--time-unit: '{stated.unit}' is none of {', '.join(UNITS_NS)}")
    known = EPOCHS.get(stated.epoch.lower())
    scale, text = known if known else (stated.scale, stated.epoch)
    match = _TEXT.fullmatch(text if "T" in text else f"{text}T00:00:00")
    if match is None:
        raise BridgeError(
            f"--epoch: '{stated.epoch}' is none of {', '.join(EPOCHS)}, nor a time such as 2000-01-01T12:00:00"
        )
    if scale is None:
        raise BridgeError(f"{name}: --epoch {stated.epoch} does not say in which scale time goes on; add --time-scale")
    if known and stated.scale not in (None, scale):
        raise BridgeError(f"{name}: --epoch {stated.epoch} is of the scale {scale}, --time-scale says {stated.scale}")
    if match[6] not in (None, "Z", "UTC") or (match[6] is not None and scale != "utc"):
        raise BridgeError(f"--epoch: '{stated.epoch}' must be a reading of the scale {scale}, without a zone")
    begun, _ = _reading(match, "--epoch", 0)
    whole = np.floor(values)
    if not np.isfinite(values).all() or (np.abs(whole) > 9.0e18 / UNITS_NS[stated.unit]).any():
        raise BridgeError(f"{name}: a time is no usable number")
    fraction_ns = np.rint((values - whole) * UNITS_NS[stated.unit]).astype(np.int64)
    return _finish(begun + whole.astype(np.int64) * UNITS_NS[stated.unit] + fraction_ns, scale, name, [])


def _finish(readings: IntArray, scale: str, name: str, notices: list[str]) -> Instants:
    """Bring readings of a scale to unix time; instants of a leap second count as the second after it."""
    if scale not in SCALES:
        raise BridgeError(f"--time-scale: '{scale}' is none of {', '.join(SCALES)}")
    unix_ns = readings
    if scale != "utc":
        tai = readings + TAI_LESS_SCALE_NS[scale]
        before = np.searchsorted(STEPS_NS + TAI_LESS_UTC_NS, tai, side="right") - 1
        _check(tai, name)
        unix_ns = tai - TAI_LESS_UTC_NS[np.maximum(before, 0)]
        following = np.minimum(before + 1, STEPS_NS.size - 1)
        within = int(np.sum((unix_ns >= STEPS_NS[following]) & (following > before)))
        if within:
            notices.append(_in_leap_seconds(name, within))
        if unix_ns.size and unix_ns.max() > int(np.datetime64(KNOWN_UNTIL, "ns").astype(np.int64)):
            notices.append(
                f"{name}: TAI - UTC is taken as 37 s after {KNOWN_UNTIL}, up to where leap seconds are known here"
            )
    _check(unix_ns, name)
    return Instants(unix_ns, tuple(notices))


def _check(readings: IntArray, name: str) -> None:
    wrong = (readings < EARLIEST_NS) | (readings >= LATEST_NS)
    if wrong.any():
        row = int(np.argmax(wrong))
        at = np.datetime64(int(readings[row]), "ns").astype("datetime64[s]")
        raise BadTimeError(
            name, row, f"the time is {at}, beyond 1972 to 2199; check --epoch, --time-unit and --time-scale"
        )
