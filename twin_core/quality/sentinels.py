"""Numbers that mean 'missing', and values that no thermometer reads."""

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.quality.policy import COLDEST_K, LEAST_READINGS, MARKERS, TEMPERATURE_MARKERS
from twin_core.quality.runs import runs_of
from twin_core.quality.spikes import largest_step

HOTTEST_K = 5000.0
"""Beyond it a temperature is a wrong unit or a marker such as 9999; the specification refuses such boundaries too."""


def marked(values: FloatArray, unit: str | None) -> BoolArray:
    """Return which values are numbers that loggers write for 'missing', (n_times,).

    Parameters
    ----------
    values : (n_times,)
        SI.
    unit
        The channel's own unit, in which the marker was written.
    """
    own = values - ZERO_CELSIUS_K if unit == "degC" else values
    markers = TEMPERATURE_MARKERS if unit in ("K", "degC") else MARKERS
    found = np.zeros(values.size, dtype=np.bool_)
    for marker in markers:
        found |= np.abs(own - marker) < 1e-6
    return found


def impossible(values_K: FloatArray) -> BoolArray:
    """Return which temperatures no thermometer reads, (n_times,)."""
    with np.errstate(invalid="ignore"):
        outside: BoolArray = (values_K < COLDEST_K) | (values_K > HOTTEST_K)
    return outside


def sentinels(time_s: FloatArray, values: FloatArray, unit: str | None) -> BoolArray:
    """Return which samples are markers of missing ones, (n_times,).

    Temperatures that cannot be always are; any other marker only where the readings leap to it and back by more than they
    ever do elsewhere. A number outside the range of all other readings that does so once is a marker wherever it stands: beside
    a heater that is off, -999 W lies nearer than the heater that is on.

    Parameters
    ----------
    time_s : (n_times,)
        Seconds, strictly increasing.
    values : (n_times,)
        SI, NaN where missing.
    unit
        The channel's own unit.
    """
    found = impossible(values) if unit in ("K", "degC") else np.zeros(values.size, dtype=np.bool_)
    doubtful = marked(values, unit) & ~found
    if not doubtful.any():
        return found
    others = np.isfinite(values) & ~found & ~doubtful
    if others.sum() < LEAST_READINGS:
        return found
    bound = largest_step(time_s[others], values[others])
    at = np.flatnonzero(np.isfinite(values) & ~found)
    first, stop = runs_of(doubtful[at])
    for begin, end in zip(first.tolist(), stop.tolist(), strict=True):
        run = at[begin:end]
        sides = [at[beside] for beside in (begin - 1, end) if 0 <= beside < at.size]
        inside = values[run[0]], values[run[-1]]
        if all(min(abs(value - values[side]) for value in inside) > bound for side in sides):
            found[run] = True
    proven = np.unique(values[found & doubtful])
    beyond = proven[(proven < values[others].min()) | (proven > values[others].max())]
    return found | (doubtful & np.isin(values, beyond))
