"""Assimilation: where the spacecraft is now, and how each reading compares with what the model expected.

An iterated extended Kalman filter: the heat balance is linearised about the filtered trajectory, all steps at once, and
the compiled linear filter runs over it. What the calibration left unexplained enters as process noise.
"""

from dataclasses import dataclass

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
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.simulate.one_step import one_step
from twin_core.telemetry import Record

N_PASSES = 3
START_STD_SENSED_K = 2.0
START_STD_HIDDEN_K = 20.0
FLOOR_SHARE = 0.02
"""Process noise per sample is at least this share of the sensor noise: a filter that is certain of itself goes deaf."""


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


def assimilate(model: CalibratedModel, record: Record, state: Json | None = None) -> Assimilation:
    """Filter a record with a calibrated model.

    Parameters
    ----------
    model
        The model, effects included.
    record
        Telemetry in SI, one segment.
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
    measured = _readings(model, network, record)
    if state is not None:
        measured[0] = np.nan
    elif not np.isfinite(measured).any():
        raise TelemetryError(f"{record.name}: holds no reading of {', '.join(model.spec.sensors)}")
    forcing = build_forcing(network, record, model.max_step_s)
    prior_mean, prior_cov = _prior(network, measured, record, state)
    filled = filled_columns(network, record.time_s, measured, prior_mean)
    stretched = np.full((forcing.n_steps + 1, measured.shape[1]), np.nan)
    stretched[forcing.sample_step] = measured
    starts = _spread(filled, forcing)
    sampling = float(np.median(np.diff(record.time_s))) if record.time_s.size > 1 else 1.0
    density = process_noise_K2_per_s(model, network, sampling)
    filtered = None
    for _ in range(N_PASSES):
        linear = _linear_model(network, forcing, starts, density, prior_mean, prior_cov, model.noise_vector_K())
        filtered = kalman_filter(linear, stretched, keep="states")
        starts = filtered.mean[:-1]
    assert filtered is not None
    at = forcing.sample_step
    return Assimilation(
        record.time_s,
        model.spec.sensors,
        filtered.innovation[at],
        filtered.innovation_std[at],
        filtered.nis[at],
        network.nodes,
        filtered.mean[-1],
        filtered.cov[-1],
    )


def _readings(model: CalibratedModel, network: Network, record: Record) -> FloatArray:
    """Return the readings with known sensor faults taken off, (n_times, n_sensors)."""
    offset_K = reading_offsets_K(network, network.parameters.values, record.clock_s)
    return measured_temperatures(model.spec, record) - offset_K


def _prior(network: Network, measured: FloatArray, record: Record, state: Json | None) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of the first state."""
    n_nodes = len(network.nodes)
    if state is not None and state["nodes"] == list(network.nodes):
        return np.array(state["mean_K"]), np.array(state["covariance_K2"]).reshape(n_nodes, n_nodes)
    mean = filled_columns(network, record.time_s, measured, None)[0]
    std = np.full(n_nodes, START_STD_HIDDEN_K)
    for sensor, node in enumerate(network.sensor_node):
        if np.isfinite(measured[:, sensor]).any():
            std[node] = START_STD_SENSED_K
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
