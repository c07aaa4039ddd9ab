"""The heat balance at the stages of a trajectory."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.network.dynamics import Balance, evaluate_balance, fill_boundaries
from twin_core.network.model import Network
from twin_core.simulate.forcing import Forcing


def balance_along(
    network: Network,
    values: FloatArray,
    forcing: Forcing,
    stages_K: FloatArray,
    first: int,
    last: int,
    *,
    derivatives: bool = False,
    extra_W: FloatArray | None = None,
) -> Balance:
    """Evaluate the heat balance at the stages of steps first..last-1, flattened to (2 n_steps, ...).

    ``extra_W`` (n_steps, n_nodes) is heat beyond the network's terms; a capacity answers to it as to any other.
    """
    boundaries = fill_boundaries(network, values, forcing.boundaries_flat_K(first, last))
    along = forcing.along(stages_K.reshape(-1, stages_K.shape[2]), boundaries, first, last)
    extra = None if extra_W is None else np.repeat(extra_W, 2, axis=0)
    return evaluate_balance(network, values, along, derivatives=derivatives, extra_W=extra)
