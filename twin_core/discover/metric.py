"""Metrics of screening: what else the readings hold, against which a candidate's response is weighed.

Heat that wanders at the nodes, as large as fitted or less, or a misfit that wanders at the sensors beside gradients within the
nodes: the descriptions by which evidence is judged (see :meth:`twin_core.discover.trial.Trial.log_evidence`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr

from twin_core._typing import FloatArray
from twin_core.calibrate.gradients import BIOT, WithGradients
from twin_core.calibrate.residual_noise import sensor_jacobians
from twin_core.calibrate.undeclared.model import HeatFit, parameter_columns, whiten

RANK = 1e-10
"""Directions that the unknowns span by less than this share of the widest one are lost to rounding."""


@dataclass(frozen=True)
class Metric:
    """How responses of the sensors are compared.

    Attributes
    ----------
    whiten
        Returns columns of all segments, one (n_samples, n_sensors, n_columns) each, whitened: (n_rows, n_columns).
    basis : (n_rows + n_priors, n_basis)
        Orthonormal: what the unknowns can mimic; the last rows are their priors.
    residual : (n_rows + n_priors,)
        What the model leaves, projected off the basis.
    """

    whiten: Callable[[Sequence[FloatArray]], FloatArray]
    basis: FloatArray
    residual: FloatArray


def beside_heat(fit: HeatFit, share: float = 1.0) -> Metric:
    """Return the metric of readings beside undeclared heat, a share of the fitted one."""
    undeclared = replace(fit.undeclared, std_W=share * fit.undeclared.std_W)

    def whitened(blocks: Sequence[FloatArray]) -> FloatArray:
        parts = [
            whiten(fit.problem, undeclared, nominal, block)[0].reshape(block.shape[0] * block.shape[1], block.shape[2])
            for nominal, block in zip(fit.nominals, blocks, strict=True)
        ]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    parameters = fit.problem.network.parameters
    std = parameters.prior_std
    columns = whitened([parameter_columns(fit.problem, fit.values, n) for n in fit.nominals])
    left = whitened([n.residual_K[:, :, None] for n in fit.nominals])[:, 0]
    return _metric(whitened, columns, left, 1.0 / std, (parameters.free - fit.free) / std)


def beside_gradients(gradients: WithGradients, *, is_white: bool = False) -> Metric:
    """Return the metric of readings beside gradients within the nodes, about trajectories that were fitted beside them.

    What stays wanders at the sensors as it does there; or, with ``is_white``, is the sensors' own noise, as it would be with
    what is missing in place. Every response is projected off the gradients of its sensor, whose priors are the last of its rows.
    """
    problem, valid = gradients.problem, gradients.whitener.valid

    def own(sensor: int, columns: FloatArray) -> FloatArray:
        seen = valid[:, sensor]
        if is_white:
            return columns[seen] / problem.noise_K[sensor]
        return gradients.whitener.whiten(sensor, np.where(seen[:, None], columns, 0.0))

    mimicked = []
    for sensor, flows in enumerate(gradients.flows_K):
        rows = np.vstack([own(sensor, flows), np.eye(flows.shape[1]) / BIOT])
        mimicked.append(qr(rows, mode="economic")[0])

    def whitened(blocks: Sequence[FloatArray]) -> FloatArray:
        columns = np.concatenate(blocks)
        return np.concatenate([_off(q, own(sensor, columns[:, sensor])) for sensor, q in enumerate(mimicked)])

    mean, std = problem.prior()
    responses = np.concatenate(
        [
            _off(mimicked[sensor], own(sensor, columns))
            for sensor, columns in sensor_jacobians(problem, gradients.optimum)
        ]
    )
    left_K = np.nan_to_num(np.concatenate(gradients.residuals))[:, :, None]
    left = np.concatenate(
        [
            _off(q, own(sensor, left_K[:, sensor]), -biot / BIOT)
            for sensor, (q, biot) in enumerate(zip(mimicked, gradients.biot, strict=True))
        ]
    )[:, 0]
    return _metric(whitened, responses, left, 1.0 / std, (mean - gradients.optimum.unknowns) / std)


def _off(basis: FloatArray, columns: FloatArray, below: FloatArray | None = None) -> FloatArray:
    """Return columns projected off an orthonormal basis with more rows; below them they are zero, or the one is ``below``."""
    rows = np.zeros((basis.shape[0], columns.shape[1]))
    rows[: columns.shape[0]] = columns
    if below is not None:
        rows[columns.shape[0] :, 0] = below
    return rows - basis @ (basis.T @ rows)


def _metric(
    whitened: Callable[[Sequence[FloatArray]], FloatArray],
    columns: FloatArray,
    left: FloatArray,
    prior_weight: FloatArray,
    to_prior: FloatArray,
) -> Metric:
    """Return the metric in which unknowns answer by whitened columns, (n_rows, n_unknowns), and so much is left, (n_rows,)."""
    design = np.vstack([columns, np.diag(prior_weight)])
    rows = np.concatenate([left, to_prior])
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    directions, singular, _ = np.linalg.svd(design / scale, full_matrices=False)
    basis = directions[:, singular > RANK * singular[0]] if singular.size else directions
    return Metric(whitened, basis, rows - basis @ (basis.T @ rows))
