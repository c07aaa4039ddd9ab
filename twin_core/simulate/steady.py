"""Steady states: the temperatures at which every node's heats are in balance."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import NoSolutionError
from twin_core.network.dynamics import evaluate_balance, fill_boundaries
from twin_core.network.model import Network
from twin_core.network.terms import Along
from twin_core.simulate.forcing import build_forcing
from twin_core.telemetry import Record

TOLERANCE_K = 1e-6
N_NEWTON = 100
LONGEST_STEP_K = 50.0
LIMIT_K = (0.5, 5.0e3)


def steady_state(network: Network, start_K: FloatArray, record: Record | None = None) -> FloatArray:
    """Return the temperatures in steady state, (n_nodes,).

    Parameters
    ----------
    network
        The network at the values of its parameters.
    start_K : (n_nodes,)
        Where Newton's method starts; any temperatures of the right order will do.
    record
        Inputs and boundary channels, of which the first sample counts; not needed where the network reads none.

    Raises
    ------
    NoSolutionError
        If there is none within physical temperatures, or a node has no way to lose heat.
    """
    along = _moment(network, record if record is not None else Record(np.array([0.0, 1.0]), {}, 0))
    temperatures = np.clip(start_K.astype(np.float64), *LIMIT_K)
    for _ in range(N_NEWTON):
        points = Along(along.time_s, temperatures[None], along.boundaries_K, along.inputs, along.sun_factor, False)
        balance = evaluate_balance(network, network.parameters.values, points)
        jacobian = balance.flow.dense()[0] * balance.own_J_per_K[:, None]
        try:
            step = np.linalg.solve(jacobian, -balance.heat_W[0])
        except np.linalg.LinAlgError as error:
            raise NoSolutionError("a node has no way to lose heat: there is no steady state") from error
        step = np.clip(step, -LONGEST_STEP_K, LONGEST_STEP_K)
        temperatures = np.clip(temperatures + step, *LIMIT_K)
        if float(np.abs(step).max()) < TOLERANCE_K:
            return temperatures
    raise NoSolutionError("Newton's method found no steady state: check the order of magnitude of heats and couplings")


def _moment(network: Network, record: Record) -> Along:
    """Return the begin of a record as the one point at which the balance is evaluated."""
    forcing = build_forcing(network, record, np.inf)
    boundaries = fill_boundaries(network, network.parameters.values, forcing.boundaries_K[0, :1])
    return Along(
        forcing.stage_time_s[0, :1] + forcing.epoch_s,
        np.zeros((1, len(network.nodes))),
        boundaries,
        {name: series[0, :1] for name, series in forcing.inputs.items()},
        forcing.sun_factor[0, :1],
        False,
    )
