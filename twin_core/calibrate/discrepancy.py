"""What parameters are wrong by because a lumped network is coarse: no noise of the readings tells of it."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from twin_core._typing import FloatArray
from twin_core.calibrate.gradients import WithGradients
from twin_core.calibrate.identifiability import identified
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import Calibration
from twin_core.parameters.transforms import is_logarithmic


@dataclass(frozen=True)
class Discrepancy:
    """How the free parameters differ beside gradients within the nodes.

    Attributes
    ----------
    weight
        Probability of gradients, against the network without them, times the share of the misfit that they explain.
    shift : (n_free,)
        In the units of the parameters; of those that are fitted by their logarithm its change times their value.
    variance : (n_free,)
        Beside gradients, in the squares of these units.
    """

    weight: float
    shift: FloatArray
    variance: FloatArray

    def added(self, variance: FloatArray) -> FloatArray:
        """Return what is to be added to variances under the noise alone, (n_free,).

        Averaged over both models (Hoeting et al. 1999), the variance about the parameters of the one that is used has the square
        of the shift, and the variance beside gradients where that is larger. The variance under the noise is kept in full, for
        gradients are not all that a coarse network lacks.
        """
        return self.weight * (self.shift**2 + np.maximum(self.variance - variance, 0.0))


def discrepancy(calibration: Calibration, gradients: WithGradients, explained: float) -> Discrepancy:
    """Return how the parameters of a calibration differ beside gradients.

    Parameters
    ----------
    calibration, gradients
        The network fitted to trajectories, and beside gradients.
    explained
        Share of the misfit that gradients explain. Where it is small, parameters may move far along what readings hardly tell.

    Raises
    ------
    ArithmeticError
        Where the readings do not tell the parameters beside gradients, or neither model has a likelihood.
    """
    gained = gradients.log_posterior - calibration.log_posterior
    if not np.isfinite(gained):
        raise ArithmeticError("the readings have no likelihood")
    n = calibration.problem.n_free
    here = calibration.network.parameters
    there = here.at_free(gradients.optimum.unknowns[:n])
    free = here.free_index
    logarithmic = np.array([is_logarithmic(here.parameters[i].transform) for i in free], dtype=bool)
    values, others = here.values[free], there.values[free]
    shift = others - values
    shift[logarithmic] = values[logarithmic] * np.log(others[logarithmic] / values[logarithmic])
    scale = there.slopes(there.free)
    scale[logarithmic] *= values[logarithmic] / others[logarithmic]
    variance = np.diag(gradients.covariance())[:n] * scale**2
    return Discrepancy(explained * float(expit(gained)), shift, variance)


def stated(model: CalibratedModel, found: Discrepancy) -> CalibratedModel:
    """Return a model whose stated deviations hold what a coarse network makes parameters wrong by.

    Its covariance stays, for a forecast counts the misfit instead, which is what the network lacks.
    """
    if not model.free_names:
        return model
    parameters = model.network().parameters
    rows = {row["name"]: row for row in model.summary["parameters"]}
    std = np.array([np.inf if rows[name]["std"] is None else rows[name]["std"] for name in model.free_names])
    std = np.sqrt(std**2 + np.where(np.isfinite(std), found.added(std**2), 0.0))
    told = identified(parameters, std / np.maximum(parameters.slopes(parameters.free), 1e-300))
    wider = {
        name: {"std": float(own) if np.isfinite(own) else None, "identified": told[name]}
        for name, own in zip(model.free_names, std, strict=True)
    }
    restated = [row | wider.get(row["name"], {}) for row in model.summary["parameters"]]
    return replace(model, summary=model.summary | {"parameters": restated})
