"""Quarters of the calendar (UTC), by which segments are divided: none holds samples of two of them."""

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

FIRST_YEAR, LAST_YEAR = 1990, 2100
_STARTS = np.arange(f"{FIRST_YEAR}-01", f"{LAST_YEAR}-02", 3, dtype="datetime64[M]").astype("datetime64[us]")
STARTS_US: list[int] = _STARTS.astype(np.int64).tolist()
"""Where quarters begin, in microseconds since 1970. What lies before the first or behind the last is a clock gone wrong, or a
record that counts from 0: neither is divided."""
EVER_US = 2**62


def quarter_of(time_us: int) -> int:
    """Return the number of the quarter that an instant lies in: 0 before the first, len(STARTS_US) behind the last."""
    return bisect_right(STARTS_US, time_us)


def start_us(quarter: int) -> int:
    """Return the instant at which a quarter begins."""
    return STARTS_US[quarter - 1] if quarter else -EVER_US


def name_of(quarter: int) -> str:
    """Return the name of a quarter, such as 2026q3."""
    return f"{FIRST_YEAR + (quarter - 1) // 4}q{(quarter - 1) % 4 + 1}"


def divided(time_us: NDArray[np.int64]) -> list[slice | NDArray[np.bool_]]:
    """Return which instants, (n_times,) in any order, belong together: one part for each quarter that holds any."""
    first, last = quarter_of(int(time_us.min())), quarter_of(int(time_us.max()))
    if first == last:
        return [slice(None)]
    quarters = np.searchsorted(STARTS_US, time_us, side="right")
    return [quarters == quarter for quarter in np.unique(quarters).tolist()]
