"""What a missing heat comes back with: the temperature, the phase of an orbit, an input, an auxiliary channel.

The heat of one half of the record is predicted from one driver alone, by the means of its bins in the other half. Heat that
repeats with the driver is predicted; heat that merely happened to go along with it is not.
"""

from collections.abc import Mapping

import numpy as np
from scipy.signal import find_peaks

from twin_core._typing import FloatArray

N_BINS = 12
N_PERIODS, N_FINER = 3, 17
"""Periods at which the spectrum of the heat stands out, and how many are tried about each: phases drift apart over a record."""

CYCLES = (3.0, 0.125)
"""Least number of cycles in the record, and most per sample, for a phase to repeat."""


def repeats_with(heat_W: FloatArray, driver: FloatArray) -> float:
    """Return the share of a heat's variance that its repetition with a driver predicts, between 0 and 1.

    Parameters
    ----------
    heat_W, driver : (n_points,)
        Evenly spaced or not; a driver that does not move predicts nothing.
    """
    if heat_W.size < 2 * N_BINS or np.ptp(driver) <= 0.0 or np.ptp(heat_W) <= 0.0:
        return 0.0
    edges = np.unique(np.quantile(driver, np.linspace(0.0, 1.0, N_BINS + 1)[1:-1]))
    at = np.searchsorted(edges, driver, side="right")
    late = np.arange(heat_W.size) >= heat_W.size // 2
    missed = np.empty_like(heat_W)
    for learned, told in ((late, ~late), (~late, late)):
        counts = np.bincount(at[learned], minlength=edges.size + 1)
        sums = np.bincount(at[learned], heat_W[learned], minlength=edges.size + 1)
        means = np.where(counts > 0, sums / np.maximum(counts, 1), heat_W[learned].mean())
        missed[told] = heat_W[told] - means[at[told]]
    return float(max(0.0, 1.0 - np.mean(missed**2) / heat_W.var()))


def phases(time_s: FloatArray, heat_W: FloatArray) -> dict[float, FloatArray]:
    """Return period in s -> phase between 0 and 1 along the record, for periods about those that stand out in a heat."""
    grid = np.linspace(time_s[0], time_s[-1], time_s.size)
    even = np.interp(grid, time_s, heat_W - heat_W.mean())
    power = np.abs(np.fft.rfft(even * np.hanning(grid.size), 4 * grid.size)) ** 2
    frequency = np.fft.rfftfreq(4 * grid.size, grid[1] - grid[0])
    cycles = frequency * (grid[-1] - grid[0])
    seen = (cycles >= CYCLES[0]) & (cycles <= CYCLES[1] * grid.size)
    peaks, _ = find_peaks(np.where(seen, power, 0.0))
    highest = frequency[peaks[np.argsort(-power[peaks])[:N_PERIODS]]]
    finer = (highest[:, None] + np.linspace(-1.0, 1.0, N_FINER) * frequency[1]).ravel()
    return {float(1.0 / f): (time_s - time_s[0]) * f % 1.0 for f in finer}


def followed(time_s: FloatArray, heat_W: FloatArray, drivers: Mapping[str, FloatArray]) -> dict[str, float]:
    """Return what a heat comes back with, and the share of its variance that this predicts, the largest first.

    Parameters
    ----------
    time_s, heat_W : (n_points,)
        The heat over time.
    drivers : name -> (n_points,)
        What it may follow; the phase of the period that tells most joins them.
    """
    shares = {name: repeats_with(heat_W, driver) for name, driver in drivers.items()}
    by_period = {period: repeats_with(heat_W, phase) for period, phase in phases(time_s, heat_W).items()}
    if by_period:
        period = max(by_period, key=lambda p: by_period[p])
        shares[f"phase of {period:.0f} s"] = by_period[period]
    return dict(sorted(shares.items(), key=lambda item: -item[1]))
