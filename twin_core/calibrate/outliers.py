"""Gross outliers: a few readings that leap away from their neighbours and come back, as no temperature does.

A heat capacity makes temperature continuous. A dropout to 0 K or a bit error is neither noise nor physics; left in, one
of them outweighs hundreds of good readings. They are left out, and the result says so.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from twin_core._typing import BoolArray, FloatArray
from twin_core.calibrate.noise import sensor_noise_K
from twin_core.calibrate.problem import measured_temperatures
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record

LONGEST_RUN = 4
"""Readings in a row that count as one excursion."""

FACTOR, LEAST_K = 30.0, 1.0
"""A leap is gross beyond this many standard deviations of what the record otherwise does, and beyond 1 K."""

COLDEST_K = 1.0
"""Nothing in a spacecraft reads less; 0 K is how a dropout looks, however long it lasts."""

AGREEMENT = 0.2
"""The readings before and after an excursion differ by less than this share of its height."""

NEARBY, DOMINANT = 8, 5.0
"""At an end of the record nothing shows that readings come back. They count only where the step to them is this many times
the largest other one nearby: a record that begins or ends in a fast transient is no excursion."""


def gross_outliers(column: FloatArray, noise_K: float) -> BoolArray:
    """Return which readings are gross outliers, (n_times,); never a missing one.

    Parameters
    ----------
    column : (n_times,)
        Readings, NaN where missing.
    noise_K
        The sensor's noise.
    """
    with np.errstate(invalid="ignore"):
        found: BoolArray = column < COLDEST_K
    at = np.flatnonzero(np.isfinite(column) & ~found)
    if at.size < 4 * LONGEST_RUN:
        return found
    values = column[at]
    leap = values - median_filter(values, size=2 * LONGEST_RUN + 1, mode="mirror")
    usual = max(float(np.median(np.abs(leap))) / 0.6745, noise_K)
    far = np.abs(leap) > max(FACTOR * usual, LEAST_K)
    edges = np.flatnonzero(np.diff(far.astype(np.int8), prepend=0, append=0))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        around = [values[i] for i in (first - 1, last) if 0 <= i < values.size]
        height = float(np.abs(leap[first:last]).min())
        returns = len(around) == 2 or _one_leap(values[max(first - NEARBY, 0) : last + NEARBY])
        if last - first <= LONGEST_RUN and np.ptp(around) < AGREEMENT * height and returns:
            found[at[first:last]] = True
    return found


def _one_leap(values: FloatArray) -> bool:
    """Return whether one step dominates all others."""
    steps = np.sort(np.abs(np.diff(values)))
    return bool(steps[-1] > DOMINANT * steps[-2])


def without_outliers(spec: TwinSpec, records: Sequence[Record]) -> list[Record]:
    """Return the records without gross outliers of their sensors, each with a notice of what was left out."""
    noise = sensor_noise_K(spec, list(records))
    return [_screened(spec, record, noise) for record in records]


def _screened(spec: TwinSpec, record: Record, noise_K: FloatArray) -> Record:
    values, notices = dict(record.values), list(record.notices)
    columns = measured_temperatures(spec, record).T
    for sensor, column, noise in zip(spec.sensors, columns, noise_K, strict=True):
        outliers = gross_outliers(column, float(noise))
        if outliers.any():
            values[sensor] = np.where(outliers, np.nan, record.values[sensor])
            first = int(np.argmax(outliers))
            notices.append(
                f"{record.name}: {int(outliers.sum())} reading(s) of '{sensor}' are none of a temperature, the first at"
                f" {record.present(record.time_s[first])} to {column[first]:.4g} K; left out as outliers"
            )
    return record if len(notices) == len(record.notices) else replace(record, values=values, notices=tuple(notices))
