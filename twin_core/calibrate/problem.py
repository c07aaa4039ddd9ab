"""What is fitted to what: the trajectories of all segments against their measured temperatures."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.calibrate.containment import check_time
from twin_core.errors import TelemetryError
from twin_core.network.dynamics import reading_offsets_K
from twin_core.network.model import Network
from twin_core.network.screened import excluded
from twin_core.network.spec import TwinSpec
from twin_core.parameters.transforms import is_logarithmic
from twin_core.simulate.forcing import Forcing, build_forcing, first_boundary_K
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import Rollout, rollout
from twin_core.telemetry import Record

START_STD_SENSED_K = 5.0
START_STD_HIDDEN_K = 30.0
"""Prior standard deviations of initial temperatures: around the first readings, and of nodes that nobody reads."""

KNOWN_START_STD_K = 1e-3
"""Of a state whose start is known: below any sensor's resolution, yet the normal equations stay well conditioned."""


@dataclass(frozen=True)
class Segment:
    """One continuous stretch of telemetry.

    Attributes
    ----------
    record
        Its samples.
    forcing
        Its steps and inputs.
    measured_K : (n_samples, n_sensors)
        NaN where a sample is missing or excluded.
    start_prior_K, start_std_K : (n_nodes,)
        Prior of the initial state.
    """

    record: Record
    forcing: Forcing
    measured_K: FloatArray
    start_prior_K: FloatArray
    start_std_K: FloatArray

    @property
    def valid(self) -> BoolArray:
        """Which samples take part, (n_samples, n_sensors)."""
        return np.isfinite(self.measured_K)


def measured_temperatures(spec: TwinSpec, record: Record) -> FloatArray:
    """Return the readings of all sensors, (n_times, n_sensors), NaN where missing or excluded."""
    nothing = np.full(record.time_s.size, np.nan)
    columns = [record.values.get(sensor, nothing) for sensor in spec.sensors]
    measured = np.stack(columns, axis=1).astype(np.float64)
    measured[excluded(record, spec.exclude)] = np.nan
    return measured


def _start_prior(network: Network, record: Record, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation of the initial temperatures, (n_nodes,) each."""
    first = np.array([c[np.isfinite(c)][:3].mean() if np.isfinite(c).any() else np.nan for c in measured.T])
    typical = float(np.nanmean(first)) if np.isfinite(first).any() else 293.15
    mean = np.full(len(network.nodes), typical)
    std = np.full(len(network.nodes), START_STD_HIDDEN_K)
    for sensor, node in enumerate(network.sensor_node):
        if np.isfinite(first[sensor]):
            mean[node], std[node] = first[sensor], START_STD_SENSED_K
    for extra in network.extra:
        position = network.layout.node(extra.name)
        if std[position] == START_STD_HIDDEN_K:
            mean[position] = mean[network.layout.node(extra.like)]
            std[position] = START_STD_SENSED_K
        if extra.follows is not None:
            mean[position], std[position] = first_boundary_K(network.spec, record, extra.follows), KNOWN_START_STD_K
    return mean, std


def build_segment(network: Network, record: Record, max_step_s: float) -> Segment:
    """Return the segment of a record; TelemetryError if it holds fewer than three samples of any sensor."""
    measured = measured_temperatures(network.spec, record)
    if record.time_s.size < 3 or int(np.isfinite(measured).sum()) < 3:
        sensors = ", ".join(network.spec.sensors)
        raise TelemetryError(f"{record.name}: fewer than three usable samples of {sensors}; give a longer record")
    mean, std = _start_prior(network, record, measured)
    return Segment(record, build_forcing(network, record, max_step_s), measured, mean, std)


@dataclass(frozen=True)
class Fit:
    """The model along all segments at one point of the search.

    Attributes
    ----------
    cost
        Half the sum of squared weighted residuals and prior deviations; infinite where a rollout has no solution.
    trajectories
        One rollout per segment.
    predicted_K
        One (n_samples, n_sensors) per segment: what the sensors should read.
    """

    cost: float
    trajectories: tuple[Rollout, ...]
    predicted_K: tuple[FloatArray, ...]


@dataclass(frozen=True)
class Problem:
    """Trajectory matching (paper A, eq. 2) over all segments, with initial states among the unknowns.

    The unknown vector x is the network's free parameters followed by the initial temperatures of each segment:
    (n_free + n_segments * n_nodes,). Residuals beyond ``huber`` times their noise count linearly instead of squared
    (Huber 1964), so that a bad reading pulls no harder than a mediocre one.
    """

    network: Network
    segments: tuple[Segment, ...]
    noise_K: FloatArray
    huber: float = np.inf

    @property
    def n_free(self) -> int:
        """Number of free network parameters."""
        return int(self.network.parameters.free_index.size)

    @property
    def n_samples(self) -> int:
        """Number of samples of all segments."""
        return sum(segment.record.time_s.size for segment in self.segments)

    @property
    def span_s(self) -> float:
        """Length of the longest segment."""
        return max(float(np.ptp(segment.record.time_s)) for segment in self.segments)

    @property
    def n_nodes(self) -> int:
        """Number of states."""
        return len(self.network.nodes)

    @property
    def n_unknowns(self) -> int:
        """Length of the unknown vector."""
        return self.n_free + len(self.segments) * self.n_nodes

    @property
    def logarithmic(self) -> IntArray:
        """Positions in the unknown vector of the parameters whose solver coordinate is logarithmic."""
        free = [self.network.parameters.parameters[i] for i in self.network.parameters.free_index]
        return np.array([k for k, p in enumerate(free) if is_logarithmic(p.transform)], dtype=np.int64)

    def step_bounds(self, unknowns: FloatArray, longest_log: float = np.inf) -> tuple[FloatArray, FloatArray]:
        """Return how far down and up one step may go from a vector of unknowns or free parameters, of its size each.

        Logarithmic parameters move by ``longest_log`` at most, each held back on its own: one that has lost its way to
        nothing asks for a move of many orders of magnitude, and a step shortened as a whole would move nothing at all.
        """
        parameters = self.network.parameters
        limit = np.full(unknowns.size, np.inf)
        limit[: self.n_free] = parameters.step_limits
        limit[self.logarithmic] = np.minimum(limit[self.logarithmic], longest_log)
        lowest = -limit
        lowest[: self.n_free] = np.maximum(lowest[: self.n_free], parameters.lowest - unknowns[: self.n_free])
        limit[: self.n_free] = np.minimum(limit[: self.n_free], parameters.highest - unknowns[: self.n_free])
        return np.minimum(lowest, 0.0), np.maximum(limit, 0.0)

    def start(self) -> FloatArray:
        """Return the unknown vector at the network's present values and the prior initial states."""
        return np.concatenate([self.network.parameters.free, *(s.start_prior_K for s in self.segments)])

    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Return mean and standard deviation of the unknowns; infinite standard deviation is a flat prior."""
        mean = np.concatenate([self.network.parameters.free, *(s.start_prior_K for s in self.segments)])
        std = np.concatenate([self.network.parameters.prior_std, *(s.start_std_K for s in self.segments)])
        return mean, std

    def prior_cost(self, unknowns: FloatArray) -> float:
        """Return the part of the cost that is the prior's, in nats."""
        mean, std = self.prior()
        return 0.5 * float(np.sum(((unknowns - mean) / std) ** 2))

    def start_columns(self, segment: int) -> slice:
        """Return where the initial temperatures of a segment stand in the unknown vector."""
        first = self.n_free + segment * self.n_nodes
        return slice(first, first + self.n_nodes)

    def values(self, unknowns: FloatArray) -> FloatArray:
        """Return the physical parameter values, (n_parameters,)."""
        return self.network.parameters.to_values(unknowns[: self.n_free])

    def solve(self, unknowns: FloatArray, near: Fit | None = None) -> Fit:
        """Roll all segments out; ``near`` is the fit from which Newton's method starts.

        Raises TimeIsUpError where the time of ``containment.limited`` is over.
        """
        values = self.values(unknowns)
        cost = self.prior_cost(unknowns)
        trajectories, predicted = [], []
        for i, segment in enumerate(self.segments):
            check_time()
            guess = None if near is None else near.trajectories[i].stages_K
            path = rollout(self.network, values, unknowns[self.start_columns(i)], segment.forcing, near=guess)
            trajectories.append(path)
            predicted.append(self._readings(values, segment, path))
            cost += self._loss((predicted[-1] - segment.measured_K) / self.noise_K)
            if not path.converged:
                cost = np.inf
                break
        return Fit(cost, tuple(trajectories), tuple(predicted))

    def _loss(self, scaled: FloatArray) -> float:
        """Return the loss of residuals in units of their noise; NaN where there is no reading."""
        size = np.abs(scaled)
        inner = np.minimum(size, self.huber)
        return float(np.nansum(inner * (size - 0.5 * inner)))

    def _readings(self, values: FloatArray, segment: Segment, path: Rollout) -> FloatArray:
        """Return what the sensors read along a trajectory, (n_samples, n_sensors)."""
        read = path.at_samples(segment.forcing.sample_step)[:, self.network.sensor_node]
        return read + reading_offsets_K(self.network, values, segment.record.clock_s)

    def residuals(self, fit: Fit) -> list[FloatArray]:
        """Return measured minus modelled per segment, (n_samples, n_sensors), NaN where missing."""
        return [s.measured_K - p for s, p in zip(self.segments, fit.predicted_K, strict=True)]

    def jacobian_stretches(
        self, unknowns: FloatArray, fit: Fit, sensors: IntArray | None = None
    ) -> Iterator[tuple[int, slice, FloatArray]]:
        """Yield (segment, samples, d predicted / d unknowns) stretch by stretch, so that long records need little memory.

        Parameters
        ----------
        unknowns, fit
            A point of the search.
        sensors : (n_wanted,)
            Which sensors; all by default.

        Yields
        ------
        int, slice, (n_samples_here, n_wanted, n_free + n_nodes)
            The columns are the free parameters followed by the segment's own initial temperatures.
        """
        values = self.values(unknowns)
        wanted = np.arange(self.network.sensor_node.size) if sensors is None else sensors
        starts = np.hstack([np.zeros((self.n_nodes, self.n_free)), np.eye(self.n_nodes)])
        for i, (segment, path) in enumerate(zip(self.segments, fit.trajectories, strict=True)):
            observed = self.network.sensor_node[wanted]
            parts = sensitivities(self.network, values, segment.forcing, path, starts, observed)
            for samples, block in parts:
                self._add_reading_derivatives(values, segment.record.clock_s, samples, wanted, block)
                yield i, samples, block

    def jacobian_blocks(self, unknowns: FloatArray, fit: Fit, sensors: IntArray | None = None) -> list[FloatArray]:
        """Return d predicted / d unknowns per segment: (n_samples, n_wanted, n_free + n_nodes)."""
        parts: list[list[FloatArray]] = [[] for _ in self.segments]
        for i, _, block in self.jacobian_stretches(unknowns, fit, sensors):
            parts[i].append(block)
        return [np.concatenate(blocks) for blocks in parts]

    def with_reading_derivatives(self, values: FloatArray, segment: Segment, block: FloatArray) -> FloatArray:
        """Return sensitivities with the derivatives of sensor faults added, (n_samples, n_sensors, n_columns)."""
        everything = np.arange(self.network.sensor_node.size)
        self._add_reading_derivatives(values, segment.record.clock_s, slice(None), everything, block)
        return block

    def _add_reading_derivatives(
        self, values: FloatArray, clock_s: FloatArray, samples: slice, sensors: IntArray, block: FloatArray
    ) -> None:
        """Add the derivatives of sensor faults to the sensitivities of some samples and sensors, in place."""
        parameters = self.network.parameters
        position = {int(index): k for k, index in enumerate(parameters.free_index)}
        at = parameters.at_values(values) if self.network.readings else parameters
        for term in self.network.readings:
            index = self.network.term_index(term)
            part = term.evaluate(clock_s, values[index])
            for column in np.flatnonzero(sensors == part.sensor):
                for item, series in part.d_values:
                    if int(index[item]) in position:
                        parameter = at.parameters[int(index[item])]
                        slope = parameter.transform.slope(parameter.free)
                        block[:, column, position[int(index[item])]] += slope * series[samples]

    def with_network(self, network: Network) -> "Problem":
        """Return the same data under another network (its effects may add states)."""
        if network.nodes == self.network.nodes:
            return replace(self, network=network)
        segments = []
        for segment in self.segments:
            mean, std = _start_prior(network, segment.record, segment.measured_K)
            segments.append(replace(segment, start_prior_K=mean, start_std_K=std))
        return replace(self, network=network, segments=tuple(segments))


def build_problem(
    network: Network, records: Sequence[Record], noise_K: FloatArray, max_step_s: float = np.inf
) -> Problem:
    """Return the fitting problem of a network and its segments of telemetry.

    Raises
    ------
    TelemetryError
        If there is no record, one of them cannot be used, or only some carry dates.
    """
    if not records:
        raise TelemetryError("no telemetry given")
    undated = [r.name for r in records if r.epoch_ns is None]
    if undated and len(undated) < len(records):
        raise TelemetryError(
            f"{undated[0]}: counts seconds, other files carry dates; give all of them one kind of time"
        )
    segments = tuple(build_segment(network, r, max_step_s) for r in records)
    for column, sensor in enumerate(network.spec.sensors):
        if not any(segment.valid[:, column].any() for segment in segments):
            where = ", ".join(dict.fromkeys(r.name for r in records))
            raise TelemetryError(
                f"{where}: channel '{sensor}' has no usable samples in what is fitted; drop the sensor from its node, or fit a"
                " part in which it was read"
            )
    return Problem(network, segments, noise_K)
