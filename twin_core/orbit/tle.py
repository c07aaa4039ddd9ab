"""Two-line element sets: what each column holds, and where SGP4 says that the spacecraft is."""

import re
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from sgp4.api import Satrec

from twin_core._typing import FloatArray
from twin_core.errors import SpecError
from twin_core.units import J2000_NS

_DAY_NS = 86_400_000_000_000
_UNIX_JULIAN_DAY = 2_440_587.5

_REAL, _SIGNED, _WHOLE = r" *[+-]?\d*\.?\d+ *", r"[ +-]\d{5}[+-]\d", r" *\d+"
_COLUMNS = (
    (
        ("satellite number", 3, 7, r"[ \dA-Z][ \d]*\d"),
        ("year of the epoch", 19, 20, r"\d\d"),
        ("day of the epoch", 21, 32, r" *\d+\.\d+ *"),
        ("drift of the mean motion", 34, 43, _REAL),
        ("second drift of the mean motion", 45, 52, _SIGNED),
        ("drag term", 54, 61, _SIGNED),
    ),
    (
        ("satellite number", 3, 7, r"[ \dA-Z][ \d]*\d"),
        ("inclination", 9, 16, _REAL),
        ("right ascension of the node", 18, 25, _REAL),
        ("eccentricity", 27, 33, r"\d{7}"),
        ("argument of perigee", 35, 42, _REAL),
        ("mean anomaly", 44, 51, _REAL),
        ("mean motion", 53, 63, _REAL),
    ),
)
"""Per line: name, first and last column (from 1), and form of what is read from it (Vallado et al., AIAA 2006-6753)."""


@dataclass(frozen=True)
class TleOrbit:
    """A two-line element set, propagated by SGP4.

    Notes
    -----
    SGP4 answers in TEME (true equator, mean equinox of date). It is used here as the equator and equinox of date, in
    which the Sun is given too: what separates the two is the equation of the equinoxes, at most 0.005 degrees. SGP4
    itself is off by about 1 km at the epoch and 1 to 3 km more a day in a low orbit (Vallado et al. 2006).
    """

    line_1: str
    line_2: str

    @property
    def epoch_ns(self) -> int:
        """Unix nanoseconds of the instant at which the elements hold."""
        satellite = _satellite(self.line_1, self.line_2)
        days = (satellite.jdsatepoch - _UNIX_JULIAN_DAY) + satellite.jdsatepochF
        return round(days * 86_400e6) * 1000

    @property
    def period_s(self) -> float:
        """Period of revolution."""
        return float(2.0 * np.pi / _satellite(self.line_1, self.line_2).no_kozai * 60.0)

    def state(self, epoch_ns: int, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position (m) and velocity (m/s), each (n_times, 3).

        Raises
        ------
        SpecError
            If the lines are no element set, or SGP4 cannot propagate to these times: the orbit has decayed.
        """
        days = (epoch_ns - J2000_NS) / _DAY_NS + np.asarray(time_s, dtype=float) / 86_400.0
        whole = np.floor(days)
        satellite = _satellite(self.line_1, self.line_2)
        codes, position_km, velocity_km_per_s = satellite.sgp4_array(2_451_545.0 + whole, days - whole)
        if codes.any():
            raise SpecError(
                f"tle: SGP4 cannot propagate to these dates (code {int(codes.max())}); give elements of their time"
            )
        return position_km * 1e3, velocity_km_per_s * 1e3


@lru_cache(maxsize=64)
def _satellite(line_1: str, line_2: str) -> Satrec:
    check_lines(line_1, line_2)
    return Satrec.twoline2rv(line_1, line_2)


def check_lines(line_1: str, line_2: str) -> None:
    """Refuse lines that are no element set, which SGP4 itself would read all the same; SpecError names the field."""
    for index, line in enumerate((line_1, line_2)):
        fault = line_fault(index + 1, line)
        if fault is not None:
            raise SpecError(f"tle[{index}]: {fault}")
    if line_1[2:7] != line_2[2:7]:
        raise SpecError(f"tle: lines of two satellites, '{line_1[2:7]}' and '{line_2[2:7]}'; copy both of one")


def line_fault(number: int, line: str) -> str | None:
    """Return what is wrong with line 1 or 2 of an element set, None where nothing is."""
    if len(line) != 69 or not line.startswith(f"{number} "):
        return f"line {number} must have 69 characters and begin with '{number} ' (got {line!r})"
    for name, first, last, form in _COLUMNS[number - 1]:
        text = line[first - 1 : last]
        if not re.fullmatch(form, text, re.ASCII):
            return f"{name} (line {number}, columns {first} to {last}) cannot be '{text}'; copy the line again"
    total = sum(int(c) if c in "0123456789" else c == "-" for c in line[:68])
    if str(total % 10) != line[68]:
        return f"checksum of line {number} is {line[68]}, must be {total % 10}; copy the line again"
    return None
