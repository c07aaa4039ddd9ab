"""What a missing heat comes back with: the temperature, the phase of an orbit, an input, an auxiliary channel.

The heat of one half of the record is predicted from one driver alone, by what the other half says of it. Heat that
repeats with the driver is predicted; heat that merely happened to go along with it is not.
"""

from collections.abc import Mapping

import numpy as np

from twin_core._typing import FloatArray

N_BINS, N_STRAIGHT = 12, 3
LEAST_VISITED = 0.25
"""Share of the record that must lie where the other half has been; with less than that the lines are drawn out instead."""

N_PERIODS, N_FINER = 3, 17
"""Periods at which the spectrum of the heat stands out, and how many are tried about each: phases drift apart over a record."""

CYCLES = (3.0, 0.125)
"""Least number of cycles in the record, and most per sample, for a phase to repeat."""


def repeats_with(heat_W: FloatArray, driver: FloatArray) -> float:
    """Return the share of a heat's variance that its repetition with a driver predicts, between 0 and 1.

    Each half of the record is predicted by a broken line through the bins of the other half. Where the record drifts, the
    driver of one half leaves what the other half visited: those points are not judged, unless they are nearly all.

    Parameters
    ----------
    heat_W, driver : (n_points,)
        Evenly spaced or not; a driver that does not move predicts nothing.
    """
    if heat_W.size < 2 * N_BINS or np.ptp(driver) <= 0.0 or np.ptp(heat_W) <= 0.0:
        return 0.0
    late = np.arange(heat_W.size) >= heat_W.size // 2
    missed, visited = np.empty_like(heat_W), np.zeros(heat_W.size, dtype=np.bool_)
    for learned, told in ((late, ~late), (~late, late)):
        missed[told] = heat_W[told] - _broken_line(driver[learned], heat_W[learned], driver[told])
        visited[told] = (driver[told] >= driver[learned].min()) & (driver[told] <= driver[learned].max())
    judged = visited if visited.mean() >= LEAST_VISITED else np.ones_like(visited)
    variance = heat_W[judged].var()
    return float(max(0.0, 1.0 - np.mean(missed[judged] ** 2) / variance)) if variance > 0.0 else 0.0


def _broken_line(driver: FloatArray, heat_W: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return a heat at the wanted values of its driver: between the means of bins that hold equal numbers of points.

    Beyond the outermost bins it goes on straight, as the ``N_STRAIGHT`` next to them do.
    """
    edges = np.unique(np.quantile(driver, np.linspace(0.0, 1.0, N_BINS + 1)[1:-1]))
    at = np.searchsorted(edges, driver, side="right")
    counts = np.bincount(at, minlength=edges.size + 1)
    held = counts > 0
    x, y = (np.bincount(at, series, minlength=counts.size)[held] / counts[held] for series in (driver, heat_W))
    line = np.interp(wanted, x, y)
    if x.size > 1:
        for some, end, beyond in (
            (slice(None, N_STRAIGHT), 0, wanted < x[0]),
            (slice(-N_STRAIGHT, None), -1, wanted > x[-1]),
        ):
            apart = x[some] - x[some].mean()
            line[beyond] = y[end] + (apart @ y[some]) / (apart @ apart) * (wanted[beyond] - x[end])
    return line


def phases(time_s: FloatArray, heat_W: FloatArray) -> dict[float, FloatArray]:
    """Return period in s -> phase between 0 and 1 along the record, for periods about those that stand out in a heat."""
    from scipy.signal import find_peaks  # loads scipy.stats: half a second that few need

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


def followed(
    time_s: FloatArray,
    heat_W: FloatArray,
    drivers: Mapping[str, FloatArray],
    *,
    own_K: FloatArray | None = None,
    others_K: Mapping[str, FloatArray] | None = None,
) -> dict[str, float]:
    """Return what a heat comes back with, and the share of its variance that this predicts, the largest first.

    Parameters
    ----------
    time_s, heat_W : (n_points,)
        The heat over time.
    drivers : name -> (n_points,)
        What it may follow; the phase of the period that tells most joins them.
    own_K, others_K : (n_points,), name -> (n_points,)
        Temperatures of the node that receives the heat, and of other nodes and boundaries: their difference drives every
        coupling.
    """
    if own_K is not None:
        apart = {f"temperature of {name} over its own": other - own_K for name, other in (others_K or {}).items()}
        drivers = {**drivers, **apart}
    shares = {name: repeats_with(heat_W, driver) for name, driver in drivers.items()}
    by_period = {period: repeats_with(heat_W, phase) for period, phase in phases(time_s, heat_W).items()}
    if by_period:
        period = max(by_period, key=lambda p: by_period[p])
        shares[f"phase of {period:.0f} s"] = by_period[period]
    return dict(sorted(shares.items(), key=lambda item: -item[1]))
