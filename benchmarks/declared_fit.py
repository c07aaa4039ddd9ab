"""What a declared network can and cannot do with a record: its structural misfit, and what its parameters imitate."""

from dataclasses import dataclass

import numpy as np

from benchmarks.case import TRAINING_SHARE
from twin_core.calibrate.residual_noise import stacked_jacobian
from twin_core.calibrate.second_order import fit_trajectories
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record


@dataclass(frozen=True)
class DeclaredFit:
    """A declared network about one solution.

    Attributes
    ----------
    values
        Parameter -> value.
    residual_K : (n_train, n_sensors)
        What the network leaves of the training part.
    directions : (n_train, n_sensors, n_unknowns)
        Orthonormal: what changes of its parameters and initial temperatures do to the readings.
    """

    values: dict[str, float]
    residual_K: np.ndarray
    directions: np.ndarray

    @property
    def misfit_K(self) -> float:
        """What the network leaves, rms over the training part and all sensors."""
        return float(np.sqrt(np.nanmean(self.residual_K**2)))

    def beyond(self, moved_K: np.ndarray) -> np.ndarray:
        """Return the part of a change of the readings, (n_times, n_sensors), that no parameter imitates, (n_train, n_sensors)."""
        moved = moved_K[: self.directions.shape[0]]
        basis = self.directions.reshape(moved.size, -1)
        return moved - (basis @ (basis.T @ moved.ravel())).reshape(moved.shape)


def training_part(record: Record) -> Record:
    """Return the first samples of a record, which effects have to show themselves in."""
    return record.take(np.arange(int(TRAINING_SHARE * record.time_s.size)))


def calibrated(spec: TwinSpec, record: Record) -> DeclaredFit:
    """Return a declared network calibrated to the training part of a record without gaps."""
    calibration = fit_trajectories(spec, [training_part(record)])
    problem, optimum = calibration.problem, calibration.optimum
    values = calibration.network.parameters.as_dict()
    jacobian = stacked_jacobian(problem, problem.jacobian_blocks(optimum.unknowns, optimum.fit))
    return DeclaredFit(values, calibration.residuals[0], _orthonormal(jacobian))


def _orthonormal(jacobian: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of what the unknowns do to the readings, (n_times, n_sensors, n_told)."""
    flat = jacobian.reshape(-1, jacobian.shape[-1])
    flat = flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
    left, sizes, _ = np.linalg.svd(flat, full_matrices=False)
    told = sizes > 1e-7 * sizes[0]
    return left[:, told].reshape(*jacobian.shape[:2], int(told.sum()))


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Return the cosine between two changes of the readings."""
    return float(abs(np.sum(one * other)) / max(np.linalg.norm(one) * np.linalg.norm(other), 1e-300))
