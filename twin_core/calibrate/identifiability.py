"""Which parameters the data can see, in numbers and in words."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.parameters.transforms import Identity, is_logarithmic
from twin_core.parameters.vector import ParameterSet

UNSEEN_STD = 1.0
"""A positive parameter whose ln is uncertain by more than this (a factor e) is not told by the data."""


def unseen_parameters(parameters: ParameterSet, std: FloatArray) -> list[str]:
    """Return names of free parameters that the data cannot see.

    Parameters
    ----------
    parameters
        The calibrated set.
    std : (n_free,)
        Posterior standard deviations in the solver's coordinate.

    Returns
    -------
    list of str
        Positive parameters uncertain by more than a factor e, signed ones by more than their own size, others by one in
        the solver's coordinate: a whole share, or an onset by as much as lies between two looks for it.
    """
    names = []
    for position, index in enumerate(parameters.free_index):
        parameter = parameters.parameters[index]
        limit = abs(parameter.value) if isinstance(parameter.transform, Identity) else UNSEEN_STD
        if not std[position] < max(limit, 1e-12):
            names.append(parameter.name)
    return names


def weakest_direction(parameters: ParameterSet, covariance: FloatArray) -> str | None:
    """Return in words the combination of free parameters that the data tell least; None if all is well told."""
    logarithmic = [k for k, i in enumerate(parameters.free_index) if is_logarithmic(parameters.parameters[i].transform)]
    if len(logarithmic) < 2:
        return None
    block = covariance[np.ix_(logarithmic, logarithmic)]
    spread, directions = np.linalg.eigh(block)
    if spread[-1] < 0.3**2:
        return None
    weights = directions[:, -1]
    strongest = np.argsort(-np.abs(weights))[:3]
    names = [parameters.free_names[logarithmic[k]] for k in strongest if abs(weights[k]) > 0.2]
    if len(names) < 2:  # one parameter that the data do not tell is said elsewhere
        return None
    factor = float(np.exp(min(np.sqrt(spread[-1]), 20.0)))
    return f"the data tell {' and '.join(names)} only together: they may move by a factor {factor:.3g} as one"


def words(parameters: ParameterSet, covariance: FloatArray) -> list[str]:
    """Return plain statements about what the data cannot see; empty where they see everything."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    said = [f"the data do not determine {name}; it stays near its guess" for name in unseen_parameters(parameters, std)]
    direction = weakest_direction(parameters, covariance)
    return said + ([direction] if direction else [])
