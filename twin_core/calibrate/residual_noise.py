"""The noise of the real residual: what a model leaves is coloured, and evidence must be weighed in that metric."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray
from twin_core.calibrate.containment import attempted
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Problem
from twin_core.gp.noise_model import ResidualNoise, fit

SEPARATION = 1.0e3
"""Segments are laid this many record lengths apart, so that their residuals are independent."""

LARGEST_JACOBIAN = 2.5e7
"""Derivatives held at once, 200 MB; longer records are gone through sensor by sensor."""


@dataclass(frozen=True)
class Whitener:
    """One residual noise model per sensor, over all segments of a problem.

    Attributes
    ----------
    time_s : (n_rows,)
        Sample times of all segments on one axis, far apart from each other.
    valid : (n_rows, n_sensors)
    models
        One per sensor: white noise plus an Ornstein-Uhlenbeck misfit.
    """

    time_s: FloatArray
    valid: np.ndarray
    models: tuple[ResidualNoise, ...]

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the residuals under the fitted noise, all sensors."""
        return float(sum(model.log_likelihood for model in self.models))

    def whiten(self, sensor: int, columns: FloatArray) -> FloatArray:
        """Return columns whitened as one sensor's residual, (n_valid, n_columns), from (n_rows, n_columns)."""
        valid = self.valid[:, sensor]
        whitened, _ = self.models[sensor].whiten(self.time_s, np.ascontiguousarray(columns), valid)
        return whitened[valid]


def one_axis(problem: Problem) -> FloatArray:
    """Return the sample times of all segments, (n_rows,), on one increasing axis with wide gaps between segments."""
    spans = [s.record.time_s - s.record.time_s[0] for s in problem.segments]
    gap = SEPARATION * max(float(t[-1]) for t in spans)
    return np.concatenate([t + i * gap for i, t in enumerate(spans)])


def fit_whitener(problem: Problem, residuals: Sequence[FloatArray], near: Whitener | None = None) -> Whitener:
    """Return the noise models of the residuals of a problem, (n_samples, n_sensors) per segment.

    With ``near``, the noise of residuals that hardly differ, each is climbed from there alone. Quantisation and the sensors'
    white noise are a floor: a residual cannot be whiter than its sensor.
    """
    time_s, stacked = one_axis(problem), np.concatenate(list(residuals))
    models = tuple(
        _fitted(time_s, column, 0.7 * float(noise), None if near is None else near.models[s])
        for s, (column, noise) in enumerate(zip(stacked.T, problem.noise_K, strict=True))
    )
    return Whitener(time_s, np.isfinite(stacked), models)


def _fitted(time_s: FloatArray, residual: FloatArray, floor_K: float, near: ResidualNoise | None) -> ResidualNoise:
    """Return the noise of one sensor; white noise as large as what is left where the fit of a coloured one fails."""
    found = attempted(lambda: fit(time_s, residual, white_floor=floor_K, near=near), "residual noise", [])
    if found is not None:
        return found
    seen = residual[np.isfinite(residual)]
    sigma_K = max(float(np.sqrt(np.mean(seen**2))), floor_K)
    return ResidualNoise(0.0, float(np.median(np.diff(time_s))), sigma_K, -np.inf)


def stacked_jacobian(problem: Problem, blocks: Sequence[FloatArray]) -> FloatArray:
    """Return d predicted / d unknowns of all segments, (n_rows, n_sensors, n_unknowns)."""
    rows = [block.shape[0] for block in blocks]
    full = np.zeros((sum(rows), blocks[0].shape[1], problem.n_unknowns))
    first = 0
    for i, block in enumerate(blocks):
        full[first : first + rows[i], :, : problem.n_free] = block[:, :, : problem.n_free]
        full[first : first + rows[i], :, problem.start_columns(i)] = block[:, :, problem.n_free :]
        first += rows[i]
    return full


def sensor_jacobians(problem: Problem, optimum: Optimum) -> Iterator[tuple[int, FloatArray]]:
    """Yield each sensor with d predicted / d unknowns of all segments, (n_rows, n_unknowns)."""
    n_sensors = problem.network.sensor_node.size
    together = max(1, int(LARGEST_JACOBIAN / (problem.n_samples * problem.n_unknowns)))
    for first in range(0, n_sensors, together):
        sensors = np.arange(first, min(first + together, n_sensors))
        jacobian = stacked_jacobian(problem, problem.jacobian_blocks(optimum.unknowns, optimum.fit, sensors))
        yield from ((int(sensor), jacobian[:, column]) for column, sensor in enumerate(sensors))
