"""Telemetry cut into windows, and the heat balance as one matrix: what a trajectory loss over batches needs.

The declared balance is linear in z = [T, sigma T^4, T_b, sigma T_b^4, u]: nodes, boundaries and inputs. Every parameter
has a constant pattern over it, so that C dT/dt = (sum of p_k E_k) z (paper A, eq. 1 and section 2.3).
"""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.calibrate.problem import Problem, Segment
from twin_core.calibrate.starting import filled_columns
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.errors import ModelError
from twin_core.network.terms import BoundaryConductor, ChannelLoad, Conductors, SinkRadiation


@dataclass(frozen=True)
class Balance:
    """The heat balance of a network as patterns.

    Attributes
    ----------
    design : (n_parameters, n_nodes, n_columns)
        E_k: heat into each node per unit of a parameter and of z.
    loads
        The declared inputs, in the order of the last columns.
    """

    design: FloatArray
    loads: tuple[ChannelLoad, ...]


def balance_of(problem: Problem) -> Balance:
    """Return the patterns of a declared network.

    Raises
    ------
    ModelError
        If a node has no sensor or a term is not linear in z: what the paper's method cannot do.
    """
    network = problem.network
    unread = [name for i, name in enumerate(network.nodes) if i not in network.sensor_node]
    if unread:
        raise ModelError(f"node '{unread[0]}' has no sensor, and every window starts from readings; use second-order")
    if (network.boundary_index >= 0).any():
        name = network.layout.boundaries[int(np.argmax(network.boundary_index >= 0))]
        raise ModelError(f"boundary '{name}' has no known temperature, which this method needs; use second-order")
    if network.parameters.ties:
        name = network.parameters.parameters[next(iter(network.parameters.ties.values()))[0]].name
        raise ModelError(f"parameter '{name}' is shared, which this method cannot do; use second-order")
    loads = tuple(term for term in network.terms if isinstance(term, ChannelLoad))
    n, n_boundaries = len(network.nodes), len(network.layout.boundaries)
    design = np.zeros((len(network.parameters), n, 2 * (n + n_boundaries) + len(loads)))
    for term, index in zip(network.terms, network.term_indices, strict=True):
        if isinstance(term, Conductors):
            for parameter, (a, b) in zip(index, term.pairs, strict=True):
                design[parameter, (a, a, b, b), (a, b, a, b)] += (-1.0, 1.0, 1.0, -1.0)
        elif isinstance(term, BoundaryConductor):
            design[index[0], term.node, (term.node, 2 * n + term.boundary)] += (-1.0, 1.0)
        elif isinstance(term, SinkRadiation):
            columns = (n + term.node, 2 * n + n_boundaries + term.boundary)
            design[index[0], term.node, columns] += (-1.0, 1.0)
        elif isinstance(term, ChannelLoad):
            design[index[0], term.node, 2 * (n + n_boundaries) + loads.index(term)] += 1.0
        else:
            raise ModelError("this method knows conductors, radiators and loads with a gain only; use second-order")
    return Balance(design, loads)


@dataclass(frozen=True)
class Windows:
    """Windows of equal length, padded at a segment's end with steps of no duration.

    Attributes
    ----------
    step_s : (n_steps, n_windows)
    given, rise : (n_steps, n_windows, n_columns - 2 n_nodes)
        Boundaries and inputs at the begin of each step, and their change over it.
    start_K : (n_windows, n_nodes)
        Readings at the start, interpolated where missing.
    measured_K : (n_steps + 1, n_windows, n_sensors)
        NaN where there is no sample, and at the start, which no parameter moves.
    validation : (n_windows,)
        Which windows are kept for validation.
    """

    step_s: FloatArray
    given: FloatArray
    rise: FloatArray
    start_K: FloatArray
    measured_K: FloatArray
    validation: BoolArray

    @property
    def n_steps(self) -> int:
        """Steps of each window."""
        return int(self.step_s.shape[0])


def cut_windows(problem: Problem, balance: Balance, window_s: float, validation_share: float) -> Windows:
    """Return all segments cut into consecutive windows of about ``window_s`` (paper A, section 4.1).

    The last windows of each segment, ``validation_share`` of them, are for validation; a single window trains.
    """
    steps = np.concatenate([s.forcing.step_s for s in problem.segments])
    longest = max(s.forcing.n_steps for s in problem.segments)
    n_steps = int(np.clip(round(window_s / float(np.median(steps))), 1, longest))
    parts = [_cut(problem, balance, segment, n_steps, validation_share) for segment in problem.segments]
    joined = [np.concatenate([getattr(p, name) for p in parts], axis=axis) for name, axis in _AXES.items()]
    return Windows(*joined)


_AXES = {"step_s": 1, "given": 1, "rise": 1, "start_K": 0, "measured_K": 1, "validation": 0}


def _cut(problem: Problem, balance: Balance, segment: Segment, n_steps: int, validation_share: float) -> Windows:
    forcing, network = segment.forcing, problem.network
    n_windows = -(-forcing.n_steps // n_steps)
    begin = np.arange(n_windows) * n_steps
    at = begin + np.arange(n_steps)[:, None]
    padded = at >= forcing.n_steps
    given, rise = _given(problem, balance, segment)
    filled = filled_columns(network, segment.record.time_s, segment.measured_K, None)
    on_grid = np.full((n_windows * n_steps + 1, network.sensor_node.size), np.nan)
    on_grid[forcing.sample_step] = segment.measured_K
    measured = on_grid[begin + np.arange(n_steps + 1)[:, None]]
    measured[0] = np.nan
    start = np.stack([np.interp(begin, forcing.sample_step, column) for column in filled.T], axis=1)
    last = np.minimum(at, forcing.n_steps - 1)
    step_s = np.where(padded, 0.0, forcing.step_s[last])
    kept = min(round(validation_share * n_windows), n_windows - 1)
    return Windows(step_s, given[last], rise[last], start, measured, np.arange(n_windows) >= n_windows - kept)


def _given(problem: Problem, balance: Balance, segment: Segment) -> tuple[FloatArray, FloatArray]:
    """Return boundaries and inputs at the begin of every step and their change over it, (n_steps, n_given) each.

    Inputs are held or linear over a step.
    """
    forcing = segment.forcing
    inputs = [load.weight * forcing.inputs[load.channel] for load in balance.loads]
    solar = [x * forcing.sun_factor if load.solar else x for x, load in zip(inputs, balance.loads, strict=True)]
    stages = np.concatenate([forcing.boundaries_K, *(x[:, :, None] for x in solar)], axis=2)
    begin, end = stages[:, 0], stages[:, 1]
    n_boundaries = forcing.boundaries_K.shape[2]

    def columns(x: FloatArray) -> FloatArray:
        boundaries = x[:, :n_boundaries]
        return np.concatenate([boundaries, SIGMA * boundaries**4, x[:, n_boundaries:]], axis=1)

    rise = columns(end) - columns(begin)
    return columns(begin), np.where(np.abs(rise) > 1e-9 * np.abs(columns(end)), rise, 0.0)
