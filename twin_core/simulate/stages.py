"""The heat balance along a trajectory."""

from collections.abc import Sequence

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
    only: Sequence[int] | None = None,
) -> Balance:
    """Evaluate the heat balance at both ends of steps first..last-1, flattened to (2 n_steps, ...).

    ``extra_W`` (n_steps, n_nodes) or (n_steps, 2, n_nodes) is heat beyond the network's terms; a capacity answers to it as to
    any other. ``only`` are the positions of the terms that count; all by default.
    """
    boundaries = fill_boundaries(network, values, forcing.boundaries_flat_K(first, last))
    along = forcing.along(stages_K.reshape(-1, stages_K.shape[2]), boundaries, first, last)
    if extra_W is not None:
        extra_W = np.repeat(extra_W, 2, axis=0) if extra_W.ndim == 2 else extra_W.reshape(-1, extra_W.shape[2])
    return evaluate_balance(network, values, along, derivatives=derivatives, extra_W=extra_W, only=only)
