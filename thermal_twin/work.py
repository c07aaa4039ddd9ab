"""What one does with a twin: calibrate, close the loop, forecast, simulate, plot."""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pandas as pd

import twin_core.calibrate
import twin_core.closed_loop
import twin_core.forecast
import twin_core.telemetry
from thermal_twin.frames import Record, index_of
from twin_core._typing import FloatArray
from twin_core.calibrate.problem import build_segment
from twin_core.calibrate.result import CalibratedModel
from twin_core.closed_loop import ClosedLoop
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.errors import ModelError, NoSolutionError
from twin_core.network.model import build_network
from twin_core.network.spec import TwinSpec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.units import from_si

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Data: TypeAlias = twin_core.telemetry.Record | pd.DataFrame
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}


def _records(spec: TwinSpec, data: Data | Sequence[Data]) -> list[twin_core.telemetry.Record]:
    """Return records of whatever telemetry is given in; several are segments of their own."""
    many = [data] if isinstance(data, twin_core.telemetry.Record | pd.DataFrame) else list(data)
    return [Record.from_dataframe(item, spec) if isinstance(item, pd.DataFrame) else item for item in many]


def calibrate(spec: TwinSpec, data: Data | Sequence[Data], **options: Any) -> CalibratedModel:
    """Fit a declared network to telemetry.

    Parameters
    ----------
    spec
        The declared network.
    data
        Records or data frames; several are segments, each with its own initial state.
    options
        ``method`` and ``loss``, as of ``twin_core.calibrate.calibrate``.
    """
    return twin_core.calibrate.calibrate(spec, _records(spec, data), **options)


def close_loop(
    spec: TwinSpec,
    data: Data | Sequence[Data],
    *,
    holdout: float | Data | Sequence[Data] = 0.3,
    **options: Any,
) -> ClosedLoop:
    """Calibrate, find what the model lacks, add it, and measure the error on telemetry kept back.

    Parameters
    ----------
    spec
        The declared network.
    data
        Records or data frames.
    holdout
        The share of the time span that is kept back at the end, or telemetry of its own.
    options
        ``burn_in_s``, ``false_alarm_rate``, ``deadline_s``, as of ``twin_core.closed_loop.close_loop``.

    Returns
    -------
    ClosedLoop
        Its ``report`` is that of the command line, its ``model`` the corrected one.
    """
    records = _records(spec, data)
    if isinstance(holdout, float | int):
        return twin_core.closed_loop.close_loop(spec, records, holdout=float(holdout), **options)
    kept = _records(spec, holdout)
    return twin_core.closed_loop.close_loop(spec, records, holdout=None, holdout_records=kept, **options)


def forecast(
    model: CalibratedModel,
    data: Data,
    horizon: float | str | pd.Timedelta,
    *,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    **options: Any,
) -> pd.DataFrame:
    """Forecast the readings after the end of telemetry.

    Parameters
    ----------
    model
        A calibrated model.
    data
        Telemetry up to now.
    horizon
        How far: seconds, ``"6h"``, ``"1d"``, or a time difference.
    quantiles
        Which ones are wanted.
    options
        ``step_s``, ``plan`` and ``inputs``, as of ``twin_core.forecast.forecast``.

    Returns
    -------
    DataFrame
        Columns (sensor, ``mean`` or ``q05`` ...), in the channels' own units, over the times ahead.
    """
    (record,) = _records(model.spec, data)
    found = twin_core.forecast.forecast(model, record, seconds(horizon), quantiles=tuple(quantiles), **options)
    columns = {}
    for i, sensor in enumerate(found.sensors):
        unit = model.spec.channels[sensor].unit
        columns[sensor, "mean"] = from_si(found.mean_K[:, i], unit)
        for q, table in found.quantiles_K.items():
            columns[sensor, f"q{100 * q:02.0f}"] = from_si(table[:, i], unit)
    return pd.DataFrame(columns, index=index_of(record, found.time_s))


def seconds(duration: float | str | pd.Timedelta) -> float:
    """Return a duration in seconds; ModelError says how to write it."""
    if isinstance(duration, pd.Timedelta):
        return float(duration.total_seconds())
    if isinstance(duration, int | float):
        return float(duration)
    if not re.fullmatch(r"(\d+(\.\d+)?(s|min|h|d|w))+", duration):
        raise ModelError(f"'{duration}' is no duration; write seconds, or '30min', '6h', '1d'")
    return sum(float(n) * _SECONDS[unit] for n, unit in re.findall(r"(\d+(?:\.\d+)?)(s|min|h|d|w)", duration))


def simulate(
    model: CalibratedModel | TwinSpec, data: Data, *, start: Mapping[str, float] | None = None
) -> pd.DataFrame:
    """Let a network run open loop along the inputs of telemetry.

    Parameters
    ----------
    model
        A calibrated model, or a specification whose values and guesses are taken as they are.
    data
        Telemetry; of the sensors only the first readings count, as initial temperatures.
    start
        Node -> initial temperature in degC; the others begin at the first readings.

    Returns
    -------
    DataFrame
        Temperature of every node in degC.

    Raises
    ------
    NoSolutionError
        If the balance has no solution within physical temperatures.
    """
    spec = model if isinstance(model, TwinSpec) else model.spec
    network = build_network(spec) if isinstance(model, TwinSpec) else model.network()
    (record,) = _records(spec, data)
    step_s = 60.0 if isinstance(model, TwinSpec) else model.max_step_s
    forcing = build_forcing(network, record, step_s)
    state_K = _start_K(network.nodes, record, build_segment(network, record, step_s).start_prior_K, start or {})
    path = rollout(network, network.parameters.values, state_K, forcing)
    if not path.converged:
        raise NoSolutionError("the heat balance has no solution along these inputs; check capacities and couplings")
    table = path.at_samples(forcing.sample_step) - ZERO_CELSIUS_K
    return pd.DataFrame(table, columns=list(network.nodes), index=index_of(record, record.time_s))


def _start_K(
    nodes: Sequence[str], record: twin_core.telemetry.Record, first_K: FloatArray, start_C: Mapping[str, float]
) -> FloatArray:
    unknown = [name for name in start_C if name not in nodes]
    if unknown:
        raise ModelError(f"unknown node '{unknown[0]}' (known: {', '.join(nodes)})")
    state = first_K.copy()
    for name, temperature in start_C.items():
        state[nodes.index(name)] = temperature + ZERO_CELSIUS_K
    return state


def plot(
    what: CalibratedModel | ClosedLoop, data: Data, *, sensors: Sequence[str] | None = None, ax: "Axes | None" = None
) -> "Axes":
    """Plot measured and modelled temperatures over time, open loop; of a closed loop before and after.

    Parameters
    ----------
    what
        A model, or a closed loop.
    data
        Telemetry to compare with.
    sensors
        Which ones; all by default.
    ax
        Where to draw; a new figure by default.
    """
    try:
        import matplotlib.pyplot as plt
    except ModuleNotFoundError as error:
        raise ModelError("plot needs matplotlib: pip install matplotlib") from error
    models = {"after": what.model, "before": what.before_model} if isinstance(what, ClosedLoop) else {"model": what}
    spec = next(iter(models.values())).spec
    (record,) = _records(spec, data)
    wanted = list(sensors or spec.sensors)
    unknown = [sensor for sensor in wanted if sensor not in spec.sensors]
    if unknown:
        raise ModelError(f"unknown sensor '{unknown[0]}' (known: {', '.join(spec.sensors)})")
    axes = plt.subplots(figsize=(9.0, 4.5), layout="constrained")[1] if ax is None else ax
    time = index_of(record, record.time_s)
    paths = {label: simulate(model, record) for label, model in models.items()}
    for sensor in wanted:
        node = next(n.id for n in spec.nodes if sensor in n.sensors)
        measured = record.values.get(sensor, np.full(record.time_s.size, np.nan)) - ZERO_CELSIUS_K
        (points,) = axes.plot(time, measured, ".", markersize=2, label=sensor)
        for label, style in zip(paths, ("-", ":"), strict=False):
            axes.plot(time, paths[label][node], style, color=points.get_color(), label=f"{sensor}, {label}")
    axes.set_xlabel("time" if record.epoch_ns is not None else "time, s")
    axes.set_ylabel("temperature, °C")
    axes.legend(fontsize="small")
    return axes
