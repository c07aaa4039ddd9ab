"""Where a calibration starts: levels of tables from the telemetry, and parameters that nobody guessed from heat balances.

The heat balance is linear in capacities, conductances, gains and table values. Integrated over windows of telemetry it
becomes a non-negative least-squares problem whose answer, biased by noise as it is, has the right order of magnitude.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import nnls

from twin_core._typing import FloatArray
from twin_core.calibrate.problem import Problem, Segment
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.model import Network
from twin_core.network.spec import TwinSpec
from twin_core.network.terms import Along
from twin_core.parameters.vector import ParameterSet
from twin_core.telemetry import Record

MAX_LEVELS = 16


def channel_levels(records: Sequence[Record], channel: str) -> tuple[float, ...]:
    """Return the values at which a channel rests, ascending.

    Samples are counted in bins of 1 % of the range; neighbouring bins that hold at least 0.5 % of the samples each are
    one level, its median. What lies between (a slew) belongs to the nearest level.
    """
    samples = np.concatenate([r.values[channel] for r in records if channel in r.values] or [np.zeros(0)])
    samples = samples[np.isfinite(samples)]
    if samples.size == 0 or samples.min() == samples.max():
        return tuple(samples[:1].tolist())
    bins = np.round((samples - samples.min()) / (0.01 * (samples.max() - samples.min()))).astype(np.int64)
    rested = np.bincount(bins) >= max(0.005 * samples.size, 2)
    group = np.where(rested, np.cumsum(np.diff(rested.astype(int), prepend=0) == 1), 0)[bins]
    levels = [(int((group == g).sum()), float(np.median(samples[group == g]))) for g in range(1, group.max() + 1)]
    return tuple(sorted(level for _, level in sorted(levels, reverse=True)[:MAX_LEVELS]))


def table_levels(spec: TwinSpec, records: Sequence[Record]) -> dict[tuple[str, str], tuple[float, ...]]:
    """Return (channel, node) -> levels, for every declared table whose knots are to be read from telemetry."""
    return {
        (load.channel, load.node): channel_levels(records, load.channel)
        for load in spec.loads
        if load.table is not None and load.table.knots is None
    }


def filled_columns(
    network: Network, time_s: FloatArray, measured_K: FloatArray, start_K: FloatArray | None
) -> FloatArray:
    """Return a temperature for every state at the samples, (n_samples, n_nodes), interpolated over gaps.

    Parameters
    ----------
    network
        Tells which sensor reads which state, and which states a conductor joins.
    time_s : (n_samples,)
    measured_K : (n_samples, n_sensors)
        NaN where missing.
    start_K : (n_nodes,)
        Where given, a state without any reading keeps this temperature; else it gets the mean of the states that a
        conductor joins it to, or of all.
    """
    filled = np.full((time_s.size, len(network.nodes)), np.nan)
    for sensor, node in enumerate(network.sensor_node):
        column = measured_K[:, sensor]
        valid = np.isfinite(column)
        if valid.any():
            filled[:, node] = np.interp(time_s, time_s[valid], column[valid])
    known = np.isfinite(filled[0])
    if start_K is not None:
        filled[:, ~known] = start_K[~known]
        return filled
    pairs = [(network.nodes.index(a), network.nodes.index(b)) for a, b in _inner_pairs(network)]
    pairs += [(network.layout.node(extra.name), network.layout.node(extra.like)) for extra in network.extra]
    for node in np.flatnonzero(~known):
        near = [b if a == node else a for a, b in pairs if node in (a, b)]
        sources = [n for n in near if known[n]] or list(np.flatnonzero(known))
        filled[:, node] = filled[:, sources].mean(axis=1)
    return filled


def _inner_pairs(network: Network) -> list[tuple[str, str]]:
    return [c.between for c in network.spec.conductors if not set(c.between) & set(network.layout.boundaries)]


def _columns(problem: Problem, segment: Segment, n_windows: int) -> tuple[FloatArray, FloatArray]:
    """Return the integrated balances of one segment: (n_windows * n_nodes, n_parameters) and known heat (rows,)."""
    network, forcing = problem.network, segment.forcing
    values = network.parameters.values
    temperatures = filled_columns(network, segment.record.time_s, segment.measured_K, None)
    after = np.concatenate([temperatures[1:], temperatures[-1:]])
    counts = np.diff(forcing.sample_step)
    stages = np.repeat(after[:-1], counts, axis=0)
    flat = np.repeat(stages[:, None], 2, axis=1)
    boundaries = forcing.boundaries_flat_K(0, forcing.n_steps)
    along: Along = forcing.along(
        flat.reshape(-1, flat.shape[2]), fill_boundaries(network, values, boundaries), 0, forcing.n_steps
    )
    window = np.minimum(np.arange(forcing.n_steps) * n_windows // max(forcing.n_steps, 1), n_windows - 1)
    n_nodes = len(network.nodes)
    design = np.zeros((n_windows, n_nodes, len(network.parameters)))
    known = np.zeros((n_windows, n_nodes))

    def integrated(series: FloatArray) -> FloatArray:
        per_step = series.reshape(forcing.n_steps, 2).mean(axis=1) * forcing.step_s
        return np.bincount(window, weights=per_step, minlength=n_windows).astype(np.float64)

    for term, index in zip(network.terms, network.term_indices, strict=True):
        part = term.evaluate(along, values[index])
        for entry in part.d_values:
            design[:, entry.node, index[entry.item]] += integrated(entry.series)
    edges = np.searchsorted(window, np.arange(n_windows + 1))
    at_edges = temperatures[np.searchsorted(forcing.sample_step, edges)]
    for node, index in enumerate(network.capacity_index):
        design[:, node, index] -= np.diff(at_edges[:, node])
    frozen = np.array([p.frozen for p in network.parameters.parameters])
    known = -(design[:, :, frozen] @ values[frozen])
    design[:, :, frozen] = 0.0
    return design.reshape(-1, len(network.parameters)), known.ravel()


def balance_start(problem: Problem, n_windows: int = 60) -> ParameterSet:
    """Return the parameters with those that nobody guessed started from integrated heat balances.

    Parameters
    ----------
    problem
        The fitting problem; its guesses are kept, weighted as the priors they are.
    n_windows
        Windows per segment.

    Returns
    -------
    ParameterSet
        Positive values of the right order of magnitude; unchanged where every parameter has a guess.
    """
    parameters = problem.network.parameters
    wanted = [i for i, p in enumerate(parameters.parameters) if p.guessed]
    if not wanted:
        return parameters
    parts = [_columns(problem, s, min(n_windows, max(4, s.forcing.n_steps // 4))) for s in problem.segments]
    design, known = np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts])
    free = [i for i in parameters.free_index if np.abs(design[:, i]).max() > 0.0]
    values = parameters.values
    scale = _column_scale(design[:, free])
    signed = [parameters.parameters[i].unit == "W" for i in free]
    columns = design[:, free] / scale
    positive_part = np.hstack([columns, -columns[:, signed]])
    guided = [k for k, i in enumerate(free) if not parameters.parameters[i].guessed and values[i] > 0]
    weight = 0.1 * float(np.linalg.norm(known) or np.linalg.norm(columns)) / max(len(guided), 1)
    pull = np.zeros((len(guided), positive_part.shape[1]))
    for row, k in enumerate(guided):
        pull[row, k] = weight / (values[free[k]] * scale[k])
    if not guided and not known.any():
        pull, weight = np.ones((1, positive_part.shape[1])), 1.0
    solution, _ = nnls(np.vstack([positive_part, pull]), np.concatenate([known, np.full(len(pull), weight)]))
    found = {i: solution[k] / scale[k] for k, i in enumerate(free)}
    for i in wanted:
        values[i] = _plausible(parameters, found, i)
    return parameters.at_values(values)


def _column_scale(columns: FloatArray) -> FloatArray:
    return np.maximum(np.linalg.norm(columns, axis=0), 1e-30)


def _plausible(parameters: ParameterSet, found: dict[int, float], i: int) -> float:
    """Return the balance's answer, or where it is zero a tenth of the geometric mean of its kind."""
    value = found.get(i, 0.0)
    if value > 0.0:
        return value
    unit = parameters.parameters[i].unit
    kind = [v for k, v in found.items() if v > 0.0 and parameters.parameters[k].unit == unit]
    return 0.1 * float(np.exp(np.mean(np.log(kind)))) if kind else parameters.parameters[i].value
