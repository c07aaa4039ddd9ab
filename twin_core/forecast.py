"""The forecast: a rollout from the assimilated state with planned inputs, mean and honest bands."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from twin_core._typing import FloatArray, Json
from twin_core.assimilate import assimilate
from twin_core.calibrate.result import CalibratedModel
from twin_core.errors import ModelError
from twin_core.network.dynamics import reading_offsets_K
from twin_core.network.model import Network
from twin_core.network.spec import TwinSpec
from twin_core.simulate.extrapolation import extrapolated_variance_K2, extrapolations, in_words
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.simulate.orbit_inputs import orbit_notices
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import Rollout, rollout
from twin_core.telemetry import Record

MAX_POINTS = 200_000


@dataclass(frozen=True)
class Forecast:
    """Future readings.

    Attributes
    ----------
    time_s : (n_times,)
        On the record's own axis.
    sensors
        Names, (n_sensors,).
    mean_K : (n_times, n_sensors)
    quantiles_K
        Probability -> (n_times, n_sensors): of what the sensors will read, their noise included.
    notices
        Where a learned effect is used outside what it was learned from.
    """

    time_s: FloatArray
    sensors: tuple[str, ...]
    mean_K: FloatArray
    quantiles_K: dict[float, FloatArray]
    notices: tuple[str, ...] = ()


def forecast(
    model: CalibratedModel,
    record: Record,
    horizon_s: float,
    *,
    step_s: float | None = None,
    plan: Record | None = None,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    state: Json | None = None,
) -> Forecast:
    """Forecast the readings after the end of a record.

    Parameters
    ----------
    model
        A calibrated model.
    record
        Telemetry up to now; its end is where the forecast starts.
    horizon_s
        Seconds ahead, positive.
    step_s
        Spacing of the forecast; the record's median sampling interval by default.
    plan
        Future inputs on the record's own time axis; inputs without a plan hold their last value.
    quantiles
        Probabilities between 0 and 1.
    state
        The ``state`` of an assimilation whose last sample is the first one of ``record``, to start the filter from.

    Returns
    -------
    Forecast
        The variance adds the state's, the parameters', the misfit that the calibration saw (growing with lead time
        up to its stationary size), the sensor's noise, and what a learned heat may be outside its visited range.

    Raises
    ------
    ModelError
        If horizon, step or a quantile is out of range, or the balance has no solution.
    """
    step = _sampling_s(record) if step_s is None else step_s
    _check(horizon_s, step, quantiles)
    network = model.network()
    values = network.parameters.values
    present_K, covariance_K2 = _present(model, record, state)
    future = future_record(model.spec, record, horizon_s, step, plan)
    forcing = build_forcing(network, future, model.max_step_s)
    path = rollout(network, values, present_K, forcing)
    if not path.converged:
        raise ModelError("the heat balance has no solution over the horizon: check the planned inputs")
    read = path.at_samples(forcing.sample_step)[:, network.sensor_node]
    read += reading_offsets_K(network, values, future.clock_s)
    wanted = np.isin(future.time_s, own_times_s(record, horizon_s, step)[1:])
    beyond = extrapolations(network, model.effects, forcing, path)
    variance = _variance(model, network, forcing, path, covariance_K2, future.time_s)
    variance += extrapolated_variance_K2(network, [b for _, b in beyond], forcing, path, network.sensor_node)
    std, mean = np.sqrt(variance)[wanted], read[wanted]
    bands = {q: mean + norm.ppf(q) * std for q in quantiles}
    notices = (*orbit_notices(model.spec, [future]), *in_words(beyond))
    return Forecast(future.time_s[wanted], model.spec.sensors, mean, bands, notices)


def _sampling_s(record: Record) -> float:
    """Return the record's median sampling interval; ModelError if it has a single sample."""
    if record.time_s.size < 2:
        raise ModelError("step_s: give one; the telemetry has a single sample and no sampling interval")
    return float(np.median(np.diff(record.time_s)))


def _present(model: CalibratedModel, record: Record, state: Json | None) -> tuple[FloatArray, FloatArray]:
    """Return mean, (n_nodes,), and covariance of the state at the end of the record."""
    if state is not None and record.time_s.size == 1:  # the state is of this very sample: nothing is left to filter
        mean = np.array(state["mean_K"], dtype=np.float64)
        return mean, np.array(state["covariance_K2"], dtype=np.float64).reshape(mean.size, mean.size)
    done = assimilate(model, record, state)
    return done.mean_K, done.covariance_K2


def _check(horizon_s: float, step_s: float, quantiles: Sequence[float]) -> None:
    if not (np.isfinite(horizon_s) and horizon_s > 0):
        raise ModelError(f"horizon_s: must be a positive number of seconds (got {horizon_s})")
    if not (np.isfinite(step_s) and 0 < step_s <= horizon_s):
        raise ModelError(f"step_s: must be positive and at most the horizon (got {step_s})")
    if horizon_s / step_s > MAX_POINTS:
        raise ModelError(f"step_s: {horizon_s / step_s:.0f} points asked for, {MAX_POINTS} at most; take a longer step")
    wrong = [q for q in quantiles if not 0.0 < q < 1.0]
    if wrong:
        raise ModelError(f"quantiles: must lie between 0 and 1, exclusive (got {wrong[0]})")


def future_record(spec: TwinSpec, record: Record, horizon_s: float, step_s: float, plan: Record | None) -> Record:
    """Return inputs and boundary temperatures over the horizon: as planned, else the last value held.

    The first sample is the present. Planned samples that lie between the forecast's own times become times too.
    """
    times = own_times_s(record, horizon_s, step_s)
    if plan is not None:
        times = np.union1d(times, plan.time_s[(plan.time_s > times[0]) & (plan.time_s < times[-1])])
    values: dict[str, FloatArray] = {}
    needed = [c for c in spec.used_channels if c not in spec.sensors or _is_boundary(spec, c)]
    for name in needed:
        column = record.values.get(name)
        finite = None if column is None else column[np.isfinite(column)]
        last = float(finite[-1]) if finite is not None and finite.size else np.nan
        values[name] = np.full(times.size, last)
        if plan is not None and name in plan.values:
            values[name] = _planned(plan, name, times, last, spec.channels[name].is_held)
    return Record(times, values, record.epoch_ns, "forecast")


def own_times_s(record: Record, horizon_s: float, step_s: float) -> FloatArray:
    """Return the times of a forecast on the record's axis, the present first, (n_times + 1,)."""
    count = int(np.floor(horizon_s / step_s + 1e-9))
    return record.time_s[-1] + step_s * np.arange(count + 1, dtype=np.float64)


def _is_boundary(spec: TwinSpec, channel: str) -> bool:
    return any(boundary.channel == channel for boundary in spec.boundaries.values())


def _planned(plan: Record, name: str, times: FloatArray, last: float, is_held: bool) -> FloatArray:
    """Return a planned channel at the forecast's times; before the plan begins the last measured value holds."""
    valid = np.isfinite(plan.values[name])
    at, column = plan.time_s[valid], plan.values[name][valid]
    if not at.size:
        return np.full(times.size, last)
    if is_held:
        position = np.searchsorted(at, times + 1e-9, side="right") - 1
        return np.where(position >= 0, column[np.maximum(position, 0)], last)
    inside = np.interp(times, at, column)
    return np.where(times >= at[0], inside, last if np.isfinite(last) else column[0])


def _variance(
    model: CalibratedModel,
    network: Network,
    forcing: Forcing,
    path: Rollout,
    state_covariance: FloatArray,
    time_s: FloatArray,
) -> FloatArray:
    """Return the variance of the readings, (n_times, n_sensors), in K^2."""
    n_free, n_nodes = int(network.parameters.free_index.size), len(network.nodes)
    starts = np.hstack([np.zeros((n_nodes, n_free)), np.eye(n_nodes)])
    covariance = np.zeros((n_free + n_nodes, n_free + n_nodes))
    if model.free_names:  # a method may state no covariance
        covariance[:n_free, :n_free] = model.covariance
    covariance[n_free:, n_free:] = state_covariance
    blocks = [
        ((block @ covariance) * block).sum(axis=-1)
        for _, block in sensitivities(network, network.parameters.values, forcing, path, starts, network.sensor_node)
    ]
    lead = (time_s - time_s[0])[:, None]
    misfit = np.array([model.misfit_K[s] for s in model.spec.sensors])
    length = np.array([model.misfit_length_s[s] for s in model.spec.sensors])
    grown = misfit**2 * (1.0 - np.exp(-2.0 * lead / np.maximum(length, 1e-9)))
    return np.concatenate(blocks) + grown + model.noise_vector_K() ** 2
