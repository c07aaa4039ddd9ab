"""Where a calibration starts: levels of tables from the telemetry, and parameters that nobody guessed from heat balances.

The heat balance is linear in capacities, conductances, gains and table values. Integrated over windows of telemetry it
tells their ratios. What it leaves open, their scale, is set by what is known and by the guesses: a residual counts as a
share of the heat that its node exchanges, so that nothing is gained where all parameters shrink together.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse.csgraph import connected_components

from twin_core._typing import FloatArray, IntArray
from twin_core.calibrate.containment import attempted
from twin_core.calibrate.problem import Problem, Segment
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.model import Network
from twin_core.network.spec import TwinSpec
from twin_core.network.surroundings import surround
from twin_core.network.terms import Along
from twin_core.parameters.transforms import Identity, is_logarithmic
from twin_core.parameters.vector import ParameterSet
from twin_core.telemetry import Record

MAX_LEVELS = 16

WINDOWS = (60, 15, 5)
"""Windows per segment: short ones see fast nodes, in long ones a slow node moves by more than its sensor's noise."""

BALANCE_MISFIT = 0.1
"""Share of the exchanged heat by which a balance may miss: its temperatures are interpolated readings."""

LARGEST_LOG_MOVE = 40.0
"""Nothing is further than e^40 from a usual heat; beyond, squares of heats would overflow."""

TYPICAL_LOG_STD = 3.0
"""How far a parameter that nobody guessed may lie from one that carries as much heat as the others, in ln."""


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


def _columns(problem: Problem, segment: Segment, n_windows: int) -> tuple[FloatArray, IntArray]:
    """Return the integrated balances of one segment, and a node that each parameter acts on, (n_parameters,).

    The balances are in J per unit of each parameter: (n_windows, n_nodes, n_parameters).
    """
    network, forcing = problem.network, segment.forcing
    values = network.parameters.values
    temperatures = filled_columns(network, segment.record.time_s, segment.measured_K, None)
    after = np.concatenate([temperatures[1:], temperatures[-1:]])
    counts = np.diff(forcing.sample_step)
    stages = np.repeat(after[:-1], counts, axis=0)
    flat = np.repeat(stages[:, None], 2, axis=1)
    boundaries = forcing.boundaries_flat_K(0, forcing.n_steps)
    filled = fill_boundaries(network, values, boundaries)
    points = forcing.along(flat.reshape(-1, flat.shape[2]), filled, 0, forcing.n_steps)
    along: Along = surround(network, values, points).along
    window = np.minimum(np.arange(forcing.n_steps) * n_windows // max(forcing.n_steps, 1), n_windows - 1)
    n_nodes = len(network.nodes)
    design = np.zeros((n_windows, n_nodes, len(network.parameters)))
    place = np.zeros(len(network.parameters), dtype=np.int64)

    def integrated(series: FloatArray) -> FloatArray:
        per_step = series.reshape(forcing.n_steps, 2).mean(axis=1) * forcing.step_s
        return np.bincount(window, weights=per_step, minlength=n_windows).astype(np.float64)

    for term, index in zip(network.terms, network.term_indices, strict=True):
        part = term.evaluate(along, values[index])
        for entry in part.d_values:
            design[:, entry.node, index[entry.item]] += integrated(entry.series)
            place[index[entry.item]] = entry.node
    edges = np.searchsorted(window, np.arange(n_windows + 1))
    at_edges = temperatures[np.searchsorted(forcing.sample_step, edges)]
    for node, index in enumerate(network.capacity_index):
        design[:, node, index] -= np.diff(at_edges[:, node])
        place[index] = node
    for i, (shared, size) in network.parameters.ties.items():
        design[:, :, shared] += size * design[:, :, i]
        design[:, :, i], place[shared] = 0.0, place[i]
    return design, place


class Balance:
    """The integrated heat balances of a problem at one length of window, as a function of the parameters.

    The terms of all nodes in all windows add to nothing at the true parameters and true temperatures.
    """

    def __init__(self, problem: Problem, n_windows: int) -> None:
        """Integrate the telemetry of all segments over ``n_windows`` windows each, fewer where they are short."""
        self.parameters, self.group = problem.network.parameters, _groups(problem.network)
        parts = [_columns(problem, s, min(n_windows, max(4, s.forcing.n_steps // 4))) for s in problem.segments]
        self.columns, self.place = np.concatenate([columns for columns, _ in parts]), parts[0][1]
        n_rows = self.columns.shape[0]
        self.window_s = sum(float(np.ptp(s.record.time_s)) for s in problem.segments) / n_rows
        every = np.concatenate([s.measured_K for s in problem.segments])
        every = every - np.nanmean(every, axis=0)
        self.spread_K = max(float(np.sqrt(np.nanmean(every**2))), float(problem.noise_K.max()))
        items = self.parameters.parameters
        moved = np.abs(self.columns).max(axis=(0, 1)) > 0.0
        linear = [is_logarithmic(p.transform) or (isinstance(p.transform, Identity) and p.unit == "W") for p in items]
        self.free = [int(i) for i in self.parameters.free_index if linear[i] and (moved[i] or items[i].guessed)]

    def typical(self) -> FloatArray:
        """Return all parameters, (n_parameters,), those that nobody guessed such that their terms carry a usual heat.

        It is the geometric mean of what the known and the guessed terms carry, among the nodes that exchange heat; where
        nothing sets a scale, gains are one.
        """
        items, values = self.parameters.parameters, self.parameters.values
        own = np.sqrt((self.columns**2).mean(axis=0))  # (n_nodes, n_parameters)
        carried = own.max(axis=0)
        floor = {"W/K": self.spread_K * self.window_s, "J/K": self.spread_K}
        carried = np.maximum(carried, [0.1 * floor.get(p.unit, 0.0) for p in items])
        group, at = self.group, self.place
        for g in range(group.max() + 1):
            inside = [i for i in range(len(items)) if group[at[i]] == g and carried[i] > 0.0]
            told = [i for i in inside if not items[i].guessed and values[i] > 0.0]
            loads = [i for i in inside if items[i].name.startswith("gain:")]
            scale = [values[i] * carried[i] for i in told] or [carried[i] for i in loads]
            heat_J = float(np.exp(np.mean(np.log(scale)))) if scale else None
            for i in inside:
                if items[i].guessed and heat_J is not None:
                    values[i] = heat_J / carried[i]
        return values

    def solve(self, start: FloatArray) -> FloatArray:
        """Return the parameters that balance best, (n_parameters,), from a start of as many.

        Guesses weigh as the priors they are; a robust loss bears the nodes whose temperature nobody reads.
        """
        items, free = self.parameters.parameters, self.free
        logarithmic = np.array([is_logarithmic(items[i].transform) for i in free])
        held = [i for i in range(len(items)) if i not in set(free)]
        known = self.columns[:, :, held] * start[held]
        rest, known_J2 = known.sum(axis=2), (known**2).sum(axis=2).mean(axis=0)
        own = self.columns[:, :, free]
        # A signed heat has no logarithm: it counts in units of the heat that the other terms carry. No logarithm needs a unit.
        unit = np.sqrt(max(float(((self.columns * start) ** 2).sum(axis=2).mean()), 1e-300))
        size = np.where(logarithmic, unit, np.maximum(np.sqrt((own**2).mean(axis=0)).max(axis=0), 1e-300))
        x0 = np.where(logarithmic, np.log(np.where(logarithmic, start[free], 1.0)), start[free] * size / unit)
        std = np.array([TYPICAL_LOG_STD if items[i].guessed else items[i].prior_std or np.inf for i in free])
        std = np.where(logarithmic, std, 1e3)

        def values_of(x: FloatArray) -> FloatArray:
            return np.where(
                logarithmic, np.exp(np.clip(x, x0 - LARGEST_LOG_MOVE, x0 + LARGEST_LOG_MOVE)), x * unit / size
            )

        def residual(x: FloatArray) -> FloatArray:
            terms = own * values_of(x)
            exchanged = np.sqrt((terms**2).sum(axis=2).mean(axis=0) + known_J2)
            missing = (terms.sum(axis=2) + rest) / (BALANCE_MISFIT * np.maximum(exchanged, 1e-300))
            return np.concatenate([missing.ravel() / np.sqrt(missing.shape[0] / 10.0), (x - x0) / std])

        if not np.isfinite(residual(x0)).all():
            raise ArithmeticError("the heat balances are not finite at the guesses")
        found = least_squares(residual, x0, loss="soft_l1", max_nfev=60)
        values = start.copy()
        values[free] = values_of(found.x)
        return self._inside(values)

    def _inside(self, values: FloatArray) -> FloatArray:
        """Return values that their transforms can take: a guess keeps within its bounds."""
        items = self.parameters.parameters
        for i in self.free:
            if is_logarithmic(items[i].transform):
                values[i] = items[i].transform.to_value(items[i].transform.to_free(float(values[i])))
        return values


def _groups(network: Network) -> IntArray:
    """Return which group of nodes that exchange heat each node belongs to, (n_nodes,)."""
    joined = np.zeros((len(network.nodes), len(network.nodes)))
    for a, b in _inner_pairs(network):
        joined[network.nodes.index(a), network.nodes.index(b)] = 1.0
    for extra in network.extra:
        joined[network.layout.node(extra.name), network.layout.node(extra.like)] = 1.0
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)


def balance_starts(problem: Problem, *, always: bool = False) -> list[ParameterSet]:
    """Return parameter sets to start from, the most telling first; one where every parameter has a guess.

    Parameters
    ----------
    problem
        The fitting problem. Declared guesses keep their values, unless ``always``: then they stay near them.
    always
        Whether balances are asked for where every parameter has a guess, too.

    Returns
    -------
    list of ParameterSet
        Positive values of the right order of magnitude: from heat balances over windows of several lengths, and from the
        heat that terms usually carry alone.
    """
    parameters = problem.network.parameters
    if not always and not any(p.guessed for p in parameters.parameters):
        return [parameters]
    found: list[FloatArray] = []
    for n_windows in WINDOWS:
        found += attempted(partial(_balanced, problem, n_windows), "balance", []) or []
    if always:
        return [parameters.at_values(values) for values in found] or [parameters]
    wanted = np.array([p.guessed or (p.unit == "W" and not p.frozen) for p in parameters.parameters])
    return [parameters.at_values(np.where(wanted, values, parameters.values)) for values in found] or [parameters]


def _balanced(problem: Problem, n_windows: int) -> list[FloatArray]:
    """Return the parameters that balance best over windows, where they can be computed, and those of a usual heat."""
    balance = Balance(problem, n_windows)
    typical = balance.typical()
    best = attempted(partial(balance.solve, typical), "balance", [])
    return [typical] if best is None else [best, typical]


def balance_start(problem: Problem) -> ParameterSet:
    """Return the first of :func:`balance_starts`."""
    return balance_starts(problem)[0]
