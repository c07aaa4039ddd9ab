"""Assimilation: where the spacecraft is now, and how each reading compares with what the model expected.

An iterated extended Kalman filter: the heat balance is linearised about the filtered trajectory, all steps at once, and
the compiled linear filter runs over it. What the calibration left unexplained enters as process noise.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.calibrate.problem import measured_temperatures
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.starting import filled_columns
from twin_core.errors import TelemetryError
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.state_space import LinearModel
from twin_core.network.dynamics import reading_offsets_K
from twin_core.network.model import Network
from twin_core.simulate.forcing import Forcing, build_forcing, first_boundary_K
from twin_core.simulate.one_step import one_step
from twin_core.telemetry import GAP_STEPS, Record

N_PASSES = 3
START_STD_SENSED_K = 2.0
START_STD_HIDDEN_K = 20.0
FLOOR_SHARE = 0.02
"""Process noise per sample is at least this share of the sensor noise: a filter that is certain of itself goes deaf."""

MOST_STEPS = 20_000
"""About so many time steps are filtered at once, whatever the record's length: memory stays bounded."""


@dataclass(frozen=True)
class Assimilation:
    """The filtered present and the way there.

    Attributes
    ----------
    time_s : (n_times,)
    sensors
        Names, (n_sensors,).
    innovation_K : (n_times, n_sensors)
        Measured minus one-step prediction; NaN where missing.
    innovation_std_K : (n_times, n_sensors)
    nis : (n_times,)
        Normalised innovation squared; its mean is the number of sensors seen where the filter is consistent.
    nodes
        Names of the states, (n_nodes,).
    mean_K, covariance_K2 : (n_nodes,), (n_nodes, n_nodes)
        State at the last sample.
    """

    time_s: FloatArray
    sensors: tuple[str, ...]
    innovation_K: FloatArray
    innovation_std_K: FloatArray
    nis: FloatArray
    nodes: tuple[str, ...]
    mean_K: FloatArray
    covariance_K2: FloatArray

    @property
    def state(self) -> Json:
        """The present as plain data, from which a later assimilation can go on."""
        return {
            "time_s": float(self.time_s[-1]),
            "nodes": list(self.nodes),
            "mean_K": self.mean_K.tolist(),
            "covariance_K2": self.covariance_K2.tolist(),
        }


def process_noise_K2_per_s(model: CalibratedModel, network: Network, sampling_s: float) -> FloatArray:
    """Return the spectral density of the process noise of each state, (n_nodes,).

    The misfit of the calibration, an Ornstein-Uhlenbeck process, moves by 2 sigma^2 h / length within a short time h;
    the process noise is given the same growth. Each state gets the mean of those that are read at least: where the
    calibration saw no misfit at all, or where nobody reads, the model is hardly better than elsewhere.
    """
    density = np.zeros(len(network.nodes))
    read = np.zeros(len(network.nodes), dtype=np.bool_)
    for sensor, node in zip(model.spec.sensors, network.sensor_node, strict=True):
        growth = 2.0 * model.misfit_K[sensor] ** 2 / max(model.misfit_length_s[sensor], sampling_s)
        floor = (FLOOR_SHARE * model.noise_K[sensor]) ** 2 / sampling_s
        density[node] = max(density[node], growth, floor)
        read[node] = True
    mean = density[read].mean()
    return np.where(read, np.maximum(density, mean), mean)


def memory_s(model: CalibratedModel, record: Record) -> float:
    """Return the longest time constant of a network in seconds: so slowly it forgets where it started.

    Parameters
    ----------
    model
        The model, effects included.
    record
        Telemetry in SI with two samples at least; the balance is linearised at the first of them, where sensors that do
        not read and nodes without one are taken to be as warm as the others.

    Returns
    -------
    float
        Infinite where the network keeps a heat for ever.

    Raises
    ------
    TelemetryError
        If the record lacks an input that the model needs, or holds no reading.
    """
    network = model.network()
    measured = readings_of(model, network, record)
    if not np.isfinite(measured).any():
        raise TelemetryError(f"{record.name}: holds no reading of {', '.join(model.spec.sensors)}")
    forcing = build_forcing(network, record.take(np.arange(2)), model.max_step_s)
    start, _ = _start(network, measured, record, None)
    steps = one_step(network, network.parameters.values, forcing, np.tile(start, (forcing.n_steps, 1)))
    slowest = float(np.abs(np.linalg.eigvals(steps.transition[0])).max())
    return -float(forcing.step_s[0]) / np.log(slowest) if 0.0 < slowest < 1.0 - 1e-12 else float("inf")


def assimilate(model: CalibratedModel, record: Record, state: Json | None = None) -> Assimilation:
    """Filter a record with a calibrated model.

    Parameters
    ----------
    model
        The model, effects included.
    record
        Telemetry in SI, one segment. After a gap of more than ``GAP_STEPS`` steps the filter starts anew.
    state
        The ``state`` of an earlier assimilation whose last sample is the first one of ``record``; its reading is then
        not used twice. By default the filter starts from the first readings.

    Returns
    -------
    Assimilation

    Raises
    ------
    TelemetryError
        If the record lacks an input that the model needs, or holds no reading.
    """
    network = model.network()
    measured = readings_of(model, network, record)
    if state is not None:
        measured[0] = np.nan
    elif not np.isfinite(measured).any():
        raise TelemetryError(f"{record.name}: holds no reading of {', '.join(model.spec.sensors)}")
    parts = record.parts(GAP_STEPS * model.max_step_s, model.spec.driving_channels)
    stops = np.cumsum([part.time_s.size for part in parts])
    now = _known(network, state)
    found: list[_Stretch] = []
    for part, readings in zip(parts, np.split(measured, stops[:-1]), strict=True):
        if now is None and not np.isfinite(readings).any():
            found.append(_Stretch.blind(readings))
            continue
        if now is None or part is not parts[0]:
            now = _start(network, readings, part, now)
        sampling_s = float(np.median(np.diff(part.time_s))) if part.time_s.size > 1 else 1.0
        density = process_noise_K2_per_s(model, network, sampling_s)
        for first, stop in _bounded(part.time_s, model.max_step_s):
            piece, fresh = part.take(np.arange(first, stop)), readings[first:stop].copy()
            if first:  # this sample ended the piece before
                fresh[0] = np.nan
            done = _filter(model, network, piece, fresh, now, density)
            found.append(done if first == 0 else done.after_first())
            now = done.mean_K, done.covariance_K2
    assert now is not None
    return Assimilation(
        record.time_s,
        model.spec.sensors,
        np.concatenate([f.innovation_K for f in found]),
        np.concatenate([f.innovation_std_K for f in found]),
        np.concatenate([f.nis for f in found]),
        network.nodes,
        *now,
    )


@dataclass(frozen=True)
class _Stretch:
    """A filtered piece of a record: one row per sample, and the state at its end."""

    innovation_K: FloatArray
    innovation_std_K: FloatArray
    nis: FloatArray
    mean_K: FloatArray
    covariance_K2: FloatArray

    @classmethod
    def blind(cls, readings: FloatArray) -> "_Stretch":
        """Return a piece about which nothing is known, not even where it starts."""
        nothing = np.full_like(readings, np.nan)
        return cls(nothing, nothing, nothing[:, 0], np.empty(0), np.empty((0, 0)))

    def after_first(self) -> "_Stretch":
        """Return the piece without its first sample."""
        return replace(
            self,
            innovation_K=self.innovation_K[1:],
            innovation_std_K=self.innovation_std_K[1:],
            nis=self.nis[1:],
        )


def _bounded(time_s: FloatArray, max_step_s: float) -> Iterator[tuple[int, int]]:
    """Yield (first, stop) of pieces of about ``MOST_STEPS`` time steps; each begins with the last sample of the one before."""
    steps = np.concatenate([[0.0], np.cumsum(np.ceil(np.diff(time_s) / max_step_s))])
    first = 0
    while True:
        stop = max(int(np.searchsorted(steps, steps[first] + MOST_STEPS, side="right")), first + 2)
        yield first, min(stop, time_s.size)
        if stop >= time_s.size:
            return
        first = stop - 1


def _filter(
    model: CalibratedModel,
    network: Network,
    record: Record,
    measured: FloatArray,
    prior: tuple[FloatArray, FloatArray],
    density: FloatArray,
) -> _Stretch:
    """Filter a piece of a record from a mean and a covariance of its first state."""
    forcing = build_forcing(network, record, model.max_step_s)
    filled = filled_columns(network, record.time_s, measured, prior[0])
    stretched = np.full((forcing.n_steps + 1, measured.shape[1]), np.nan)
    stretched[forcing.sample_step] = measured
    starts = _spread(filled, forcing)
    filtered = None
    for _ in range(N_PASSES):
        linear = _linear_model(network, forcing, starts, density, *prior, model.noise_vector_K())
        filtered = kalman_filter(linear, stretched, keep="states")
        starts = filtered.mean[:-1]
    assert filtered is not None
    at = forcing.sample_step
    return _Stretch(
        filtered.innovation[at], filtered.innovation_std[at], filtered.nis[at], filtered.mean[-1], filtered.cov[-1]
    )


def readings_of(model: CalibratedModel, network: Network, record: Record) -> FloatArray:
    """Return the readings with known sensor faults taken off, (n_times, n_sensors)."""
    offset_K = reading_offsets_K(network, network.parameters.values, record.clock_s)
    return measured_temperatures(model.spec, record) - offset_K


def _known(network: Network, state: Json | None) -> tuple[FloatArray, FloatArray] | None:
    """Return mean and covariance of an earlier assimilation; None if there is none, or of other nodes."""
    if state is None or state["nodes"] != list(network.nodes):
        return None
    n_nodes = len(network.nodes)
    return np.array(state["mean_K"]), np.array(state["covariance_K2"]).reshape(n_nodes, n_nodes)


def _start(
    network: Network, measured: FloatArray, record: Record, before_gap: tuple[FloatArray, FloatArray] | None
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance where a record starts; where it holds no reading, what was known before the gap stays."""
    std = np.full(len(network.nodes), START_STD_HIDDEN_K)
    if before_gap is not None and not np.isfinite(measured).any():
        return before_gap[0], np.diag(std**2)
    for sensor, node in enumerate(network.sensor_node):
        if np.isfinite(measured[:, sensor]).any():
            std[node] = START_STD_SENSED_K
    mean = filled_columns(network, record.time_s, measured, None)[0]
    for extra in network.extra:
        if extra.follows is not None:
            at = network.layout.node(extra.name)
            mean[at], std[at] = first_boundary_K(network.spec, record, extra.follows), START_STD_SENSED_K
    return mean, np.diag(std**2)


def _spread(filled: FloatArray, forcing: Forcing) -> FloatArray:
    """Return a temperature at the start of each step, (n_steps, n_nodes), from one per sample."""
    position = np.interp(np.arange(forcing.n_steps), forcing.sample_step, np.arange(filled.shape[0]))
    left = np.floor(position).astype(int)
    return filled[left]


def _linear_model(
    network: Network,
    forcing: Forcing,
    starts_K: FloatArray,
    density: FloatArray,
    prior_mean: FloatArray,
    prior_cov: FloatArray,
    noise_K: FloatArray,
) -> LinearModel:
    """Return the linear model of all steps about their starts."""
    steps = one_step(network, network.parameters.values, forcing, starts_K)
    offset = steps.ends_K - np.einsum("kij,kj->ki", steps.transition, starts_K)
    process = density * forcing.step_s[:, None]
    process_cov = process[:, :, None] * np.eye(density.size)
    observation = np.zeros((noise_K.size, density.size))
    observation[np.arange(noise_K.size), network.sensor_node] = 1.0
    alone = forcing.n_steps == 0  # one sample: nothing moves, yet the filter wants a matrix
    return LinearModel.build(
        transition=np.eye(density.size) if alone else steps.transition,
        process_cov=np.zeros((density.size, density.size)) if alone else process_cov,
        offset=offset,
        observation=observation,
        noise_variance=noise_K**2,
        prior_mean=prior_mean,
        prior_cov=prior_cov,
        n_times=forcing.n_steps + 1,
    )
