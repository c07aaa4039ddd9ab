"""``twin forecast``: what the sensors will read, with quantiles."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from replay.cli.command import FILE, Command
from replay.cli.durations import POSITIVE_DURATION
from replay.cli.effects import effects_option

if TYPE_CHECKING:
    from twin_core.calibrate import CalibratedModel
    from twin_core.forecast import Forecast, Inputs
    from twin_core.telemetry import Record

_OUT = (".csv", ".json")
_OPTIONS = {"horizon_s": "'--horizon'", "step_s": "'--step'"}
"""The options behind the arguments of :func:`twin_core.forecast.forecast`."""


@click.command(
    cls=Command,
    short_help="Forecast temperatures with quantiles.",
    example="twin forecast --model model.json --telemetry today.csv --horizon 1d --out tomorrow.csv",
)
@click.option("--model", "model_file", required=True, type=FILE, help="Model of twin calibrate or twin close-loop.")
@click.option(
    "--telemetry", required=True, multiple=True, metavar="FILE", type=FILE, help="CSV or MCAP file up to now."
)
@click.option("--horizon", required=True, type=POSITIVE_DURATION, help="How far to look ahead: seconds, or 6h, 1d.")
@click.option(
    "--step",
    type=POSITIVE_DURATION,
    help="Time between forecasts, at most the horizon: seconds, or 10min.  [default: as the telemetry is sampled]",
)
@click.option("--plan", type=FILE, help="Planned inputs, CSV or MCAP.")
@click.option(
    "--inputs",
    type=click.Choice(["auto", "repeat", "hold"]),
    default="auto",
    show_default=True,
    help="Inputs without a plan: repeat the last period (auto: where there is one), or hold the last value.",
)
@click.option("--no-masking", is_flag=True, help="Take every sample as a reading, frozen ones and spikes too.")
@click.option("--out", required=True, type=FILE, help="Forecast to write, .csv or .json.")
@effects_option
@click.option("--json", "as_json", is_flag=True, help="Print the forecast as JSON.")
def forecast(
    model_file: Path,
    telemetry: tuple[Path, ...],
    horizon: float,
    step: float | None,
    plan: Path | None,
    inputs: "Inputs",
    no_masking: bool,
    out: Path,
    as_json: bool,
) -> None:
    """Forecast temperatures from the end of a record, with mean and quantiles in each channel's unit."""
    from replay.cli.console import notify, print_line, to_json
    from replay.cli.models import load_model
    from replay.cli.recordings import check_suffix, load_segments
    from replay.wording import counted
    from twin_core.errors import ArgumentError, TelemetryError
    from twin_core.forecast import forecast as look_ahead

    check_suffix(out, _OUT)
    if len(telemetry) > 1:
        raise TelemetryError(f"{telemetry[1]}: a forecast starts at the end of one file; name one")
    model = load_model(model_file)
    record = load_segments(telemetry[:1], model.spec, masking=not no_masking)[-1]
    if step is None and record.time_s.size < 2:
        raise TelemetryError(f"{record.name}: holds one sample, which tells no sampling interval; give --step")
    planned = _load_plan(plan, record, model, horizon) if plan else None
    try:
        result = look_ahead(model, record, horizon, step_s=step, plan=planned, inputs=inputs)
    except ArgumentError as error:
        raise click.BadParameter(error.reason, param_hint=_OPTIONS[error.argument]) from error
    document = _document(result, record, model)
    _write(out, document)
    notify([*record.notices, *(planned.notices if planned else ()), *result.notices])
    if as_json:
        print_line(to_json(document).rstrip())
    else:
        print_line(f"{out}: {counted(len(result.time_s), 'instant')} of {counted(len(result.sensors), 'sensor')}")


def _load_plan(path: Path, record: "Record", model: "CalibratedModel", horizon_s: float) -> "Record":
    """Return the planned inputs on the time axis of the record."""
    from dataclasses import replace

    from replay.cli.recordings import load_record
    from twin_core.errors import TelemetryError

    plan = load_record(path, model.spec, required=())
    if plan.notices:
        raise TelemetryError(f"{plan.notices[0].replace('ignored columns', 'has columns')}; correct or remove them")
    inputs = [name for name in plan.values if name not in model.spec.sensors]
    if not inputs:
        raise TelemetryError(f"{path}: plans no input; give columns of power, auxiliary or boundary channels")
    if (plan.epoch_ns is None) != (record.epoch_ns is None):
        raise TelemetryError(f"{path}: must write time in the form of {record.name} (dates or seconds)")
    readings = [name for name in plan.values if name in model.spec.sensors]
    notices = (f"{path}: ignored {', '.join(readings)}, which the forecast predicts",) if readings else ()
    shift_s = 0.0 if plan.epoch_ns is None or record.epoch_ns is None else (plan.epoch_ns - record.epoch_ns) / 1e9
    planned = {name: plan.values[name] for name in inputs}
    shifted = replace(plan, time_s=plan.time_s + shift_s, values=planned, epoch_ns=record.epoch_ns, notices=notices)
    _check_plan(shifted, inputs, float(record.time_s[-1]), horizon_s)
    return shifted


def _check_plan(plan: "Record", inputs: list[str], now_s: float, horizon_s: float) -> None:
    """Refuse a plan that would change nothing."""
    import numpy as np

    from twin_core.errors import TelemetryError

    empty = [name for name in inputs if not np.isfinite(plan.values[name]).any()]
    if empty:
        raise TelemetryError(f"{plan.name}: plans no value of {', '.join(empty)}; give some or leave the column out")
    first_s, last_s = float(plan.time_s[0]), float(plan.time_s[-1])
    if last_s < now_s:
        raise TelemetryError(
            f"{plan.name}: ends at {plan.present(last_s)}, before the forecast begins at {plan.present(now_s)}"
        )
    if first_s > now_s + horizon_s:
        end = plan.present(now_s + horizon_s)
        raise TelemetryError(f"{plan.name}: begins at {plan.present(first_s)}, after the forecast ends at {end}")


def _document(result: "Forecast", record: "Record", model: "CalibratedModel") -> dict[str, Any]:
    """Return the forecast in the form that the service answers with, times in the telemetry's own form."""
    from twin_core.forecast import WHOLE
    from twin_core.units import from_si

    units = {sensor: model.spec.channels[sensor].unit for sensor in result.sensors}
    values = {}
    for i, (sensor, unit) in enumerate(units.items()):
        bands = {f"q{100 * q:02.0f}": from_si(table[:, i], unit).tolist() for q, table in result.quantiles_K.items()}
        values[sensor] = {"mean": from_si(result.mean_K[:, i], unit).tolist()} | bands
    bounds = {
        sensor: {
            end: from_si(table[:, i], unit).tolist() for end, table in zip(("low", "high"), result.whole_K, strict=True)
        }
        for i, (sensor, unit) in enumerate(units.items())
    }
    time = [record.present(t) for t in result.time_s.tolist()]
    issued = record.present(float(record.time_s[-1]))
    return {
        "issued": issued,
        "time": time,
        "values": values,
        "whole": {"probability": WHOLE, "values": bounds},
        "units": units,
        "inputs": dict(result.inputs),
        "notices": list(result.notices),
    }


def _write(out: Path, document: dict[str, Any]) -> None:
    from replay.cli.console import to_json
    from twin_core.files import write_text

    if out.suffix == ".json":
        write_text(out, to_json(document))
        return
    name = "time" if isinstance(document["time"][0], str) else "time_s"
    columns = {f"{sensor}_{kind}": c for sensor, kinds in document["values"].items() for kind, c in kinds.items()}
    rows = zip(document["time"], *(map("{:.6f}".format, column) for column in columns.values()), strict=True)
    lines = [",".join([name, *columns]), *(",".join(map(str, row)) for row in rows)]
    write_text(out, "\n".join(lines) + "\n")
