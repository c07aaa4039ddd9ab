"""The forecast: a rollout from the assimilated state, mean and honest bands whether or not the inputs are planned."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.assimilate import assimilate
from twin_core.calibrate.result import CalibratedModel
from twin_core.errors import ArgumentError, ModelError
from twin_core.forecast.assumed import How, Inputs, assume, future_record, own_times_s
from twin_core.forecast.bands import mixture_quantiles, whole_path_factor
from twin_core.forecast.past import Missed, deviations_K, missed
from twin_core.forecast.spread import Spread, spread
from twin_core.network.dynamics import reading_offsets_K
from twin_core.simulate.extrapolation import extrapolations, in_words
from twin_core.simulate.forcing import MOST_STEPS, build_forcing
from twin_core.simulate.orbit_inputs import orbit_notices
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

MAX_POINTS = 200_000
WHOLE = 0.9
"""Probability with which a sensor's whole path stays in its simultaneous band."""


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
    whole_K
        Low and high, (n_times, n_sensors) each: a sensor's readings all stay between them with probability ``WHOLE``.
    present_K : (n_sensors,)
        What the sensors read by the state from which the forecast starts.
    inputs
        Driving channel -> where its future comes from.
    notices
        What was assumed of inputs that vary, and where a learned effect is used outside what it was learned from.
    """

    time_s: FloatArray
    sensors: tuple[str, ...]
    mean_K: FloatArray
    quantiles_K: dict[float, FloatArray]
    whole_K: tuple[FloatArray, FloatArray]
    present_K: FloatArray
    inputs: Mapping[str, How] = field(default_factory=dict)
    notices: tuple[str, ...] = ()


def forecast(
    model: CalibratedModel,
    record: Record,
    horizon_s: float,
    *,
    step_s: float | None = None,
    plan: Record | None = None,
    inputs: Inputs = "auto",
    past: Record | None = None,
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
        Future inputs on the record's own time axis.
    inputs
        What channels without a plan do: ``auto`` repeats the last period of those that have one and holds the others,
        ``repeat`` repeats all, ``hold`` holds all. What comes from the orbit is computed.
    past
        Telemetry from which that is told, on the record's own time axis; the record by default.
    quantiles
        Probabilities between 0 and 1.
    state
        The ``state`` of an assimilation whose last sample is the first one of ``record``, to start the filter from.

    Returns
    -------
    Forecast
        The bands contain the state's uncertainty, the parameters', the misfit that the calibration saw (growing up to its
        stationary size as the network forgets where it started), the sensor's noise, what a learned heat may be outside
        its visited range, and what the assumed inputs missed in the past over the same lead times.

    Raises
    ------
    ArgumentError
        If horizon, step or a quantile is out of range.
    ModelError
        If the inputs are none that there are, or the balance has no solution.
    """
    step = _sampling_s(record) if step_s is None else step_s
    _check(horizon_s, step, quantiles, model.max_step_s)
    network = model.network()
    values = network.parameters.values
    present_K, covariance_K2 = _present(model, record, state)
    now_s = float(record.time_s[-1])
    before = _up_to(record if past is None else past, now_s)
    assumed = assume(model.spec, before, plan, inputs, _orbit_period_s(model))
    future = future_record(model.spec, record, horizon_s, step, plan, assumed.rules)
    forcing = build_forcing(network, future, model.max_step_s)
    path = rollout(network, values, present_K, forcing)
    if not path.converged:
        raise ModelError("the heat balance has no solution over the horizon: check the planned inputs")
    wanted = np.flatnonzero(np.isin(future.time_s, own_times_s(record, horizon_s, step)[1:]))
    read = path.at_samples(forcing.sample_step)[:, network.sensor_node]
    read = read + reading_offsets_K(network, values, future.clock_s)
    here = read[wanted]
    beyond = extrapolations(network, model.effects, forcing, path)
    sampling_s = next((_sampling_s(r) for r in (record, before) if r.time_s.size > 1), step)
    outside = [b for _, b in beyond]
    about = spread(model, network, forcing, path, covariance_K2, future.time_s, wanted, outside, sampling_s)
    found = missed(assumed.rules, now_s, forcing)
    members_K = np.zeros((0, *here.shape))
    if found is not None:
        members_K = deviations_K(network, values, forcing, path, assumed.rules, found, wanted)
    bands = mixture_quantiles({*quantiles, *_BAND}, np.sqrt(about.variance_K2), members_K)
    low, high = _whole(about, members_K, bands, model.noise_vector_K())
    mean = here + members_K.mean(axis=0) if found is not None else here
    short = () if found is None else _short(found, horizon_s)
    notices = (*orbit_notices(model.spec, [future]), *assumed.in_words(), *short, *in_words(beyond))
    made = {q: here + bands[q] for q in quantiles}
    whole = here + low, here + high
    return Forecast(future.time_s[wanted], model.spec.sensors, mean, made, whole, read[0], assumed.how, notices)


_BAND = (round(0.5 - 0.5 * WHOLE, 9), 0.5, round(0.5 + 0.5 * WHOLE, 9))
"""The quantiles that are widened to the simultaneous band."""


def _whole(
    about: Spread, members_K: FloatArray, bands: Mapping[float, FloatArray], noise_K: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return low and high, (n_times, n_sensors) each, about the rollout: a sensor's whole path stays inside with ``WHOLE``."""
    kept = about.kept
    low, middle, high = (bands[q] for q in _BAND)
    at_kept = low[kept], middle[kept], high[kept]
    n_between = low.shape[0] / kept.size
    factor = whole_path_factor(WHOLE, about.paths_K, members_K[:, kept], noise_K, n_between, at_kept)
    return middle - factor * (middle - low), middle + factor * (high - middle)


def _up_to(past: Record, now_s: float) -> Record:
    """Return the past without what came later than the present."""
    return past.take(past.time_s <= now_s) if past.time_s[0] <= now_s else past.take(np.array([0]))


def _orbit_period_s(model: CalibratedModel) -> float | None:
    """Return the period of the declared orbit, None where there is none."""
    return None if model.spec.orbit is None else model.spec.orbit.elements.period_s


def _short(found: Missed, horizon_s: float) -> tuple[str, ...]:
    """Say that the past tells little of so long a horizon, if so."""
    if found.known_s >= horizon_s * (1.0 - 1e-9):
        return ()
    return (
        f"the past tells how inputs go on for {found.known_s:.4g} s, the forecast is over {horizon_s:.4g} s: "
        "its bands may be too narrow beyond",
    )


def _sampling_s(record: Record) -> float:
    """Return the record's median sampling interval; ArgumentError if it has a single sample."""
    if record.time_s.size < 2:
        raise ArgumentError("step_s", "give one; the telemetry has a single sample and no sampling interval")
    return float(np.median(np.diff(record.time_s)))


def _present(model: CalibratedModel, record: Record, state: Json | None) -> tuple[FloatArray, FloatArray]:
    """Return mean, (n_nodes,), and covariance of the state at the end of the record."""
    if state is not None and record.time_s.size == 1:  # the state is of this very sample: nothing is left to filter
        mean = np.array(state["mean_K"], dtype=np.float64)
        return mean, np.array(state["covariance_K2"], dtype=np.float64).reshape(mean.size, mean.size)
    done = assimilate(model, record, state)
    return done.mean_K, done.covariance_K2


def _check(horizon_s: float, step_s: float, quantiles: Sequence[float], max_step_s: float) -> None:
    if not (np.isfinite(horizon_s) and horizon_s > 0):
        raise ArgumentError("horizon_s", f"must be a positive number of seconds (got {horizon_s})")
    if not (np.isfinite(step_s) and 0 < step_s <= horizon_s):
        it_is = f"it is {step_s:g} s; where none is given it is the sampling interval"
        raise ArgumentError("step_s", f"must be positive and at most the horizon of {horizon_s:g} s; {it_is}")
    if horizon_s / step_s > MAX_POINTS:
        asked = f"{horizon_s / step_s:.0f} points asked for, {MAX_POINTS} at most"
        raise ArgumentError("step_s", f"{asked}; give a longer step or a shorter horizon")
    if horizon_s / max_step_s > MOST_STEPS:
        raise ArgumentError(
            "horizon_s",
            f"{horizon_s:.4g} s are {horizon_s / max_step_s:.3g} steps of at most {max_step_s:.3g} s, as this network "
            f"needs them; ask for {MOST_STEPS * max_step_s:.3g} s or less",
        )
    wrong = [q for q in quantiles if not 0.0 < q < 1.0]
    if wrong:
        raise ArgumentError("quantiles", f"must lie between 0 and 1, exclusive (got {wrong[0]})")
