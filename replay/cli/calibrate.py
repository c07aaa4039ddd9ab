"""``twin calibrate``: fits the declared network to telemetry."""

from pathlib import Path
from typing import Any

import click

from replay.cli.command import FILE, Command
from replay.cli.durations import POSITIVE_DURATION
from replay.cli.effects import effects_option

POSITIVE = click.FloatRange(min=0.0, min_open=True)


@click.command(
    cls=Command,
    short_help="Fit the declared network to telemetry.",
    example="twin calibrate --spec sat.yaml --telemetry day1.csv day2.csv --out model.json",
)
@click.option("--spec", "spec_file", required=True, type=FILE, help="Specification, YAML or JSON.")
@click.option(
    "--telemetry",
    required=True,
    multiple=True,
    metavar="FILE...",
    type=FILE,
    help="CSV or MCAP files, one per segment.",
)
@click.option(
    "--method",
    default="second-order",
    show_default=True,
    type=click.Choice(["second-order", "neural-ode"]),
    help="How to fit.",
)
@click.option(
    "--loss",
    default="squared",
    show_default=True,
    type=click.Choice(["squared", "huber"]),
    help="huber for readings with outliers.",
)
@click.option("--learning-rate", type=POSITIVE, help="Of neural-ode: Adam's.  [default: 0.01]")
@click.option("--window", type=POSITIVE_DURATION, help="Of neural-ode: length of a training window.  [default: 2000 s]")
@click.option("--epochs", type=click.IntRange(min=1), help="Of neural-ode: at most.  [default: 2000]")
@click.option(
    "--patience",
    type=click.IntRange(min=1),
    help="Of neural-ode: epochs without a lower validation loss until it stops.  [default: 200]",
)
@click.option("--start", metavar="TIME", help="Take only samples from this time on.")
@click.option("--stop", metavar="TIME", help="Take only samples before this time.")
@click.option("--samples", type=click.IntRange(min=20), help="Take at most so many, the newest.  [default: all]")
@click.option("--thin", is_flag=True, help="Take them evenly over that time; inputs that hold have their mean.")
@click.option("--no-masking", is_flag=True, help="Take every sample as a reading, frozen ones and spikes too.")
@click.option("--deadline", type=POSITIVE_DURATION, help="Best answer after so many seconds (or 5min).")
@click.option("--out", required=True, type=FILE, help="Model to write, .json.")
@effects_option
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def calibrate(
    spec_file: Path,
    telemetry: tuple[Path, ...],
    method: str,
    loss: str,
    learning_rate: float | None,
    window: float | None,
    epochs: int | None,
    patience: int | None,
    start: str | None,
    stop: str | None,
    samples: int | None,
    thin: bool,
    no_masking: bool,
    deadline: float | None,
    out: Path,
    as_json: bool,
) -> None:
    """Calibrate the declared network against telemetry, with the uncertainty of every parameter."""
    from replay.cli.console import notify, print_line, progress_bar, to_json
    from replay.cli.recordings import check_suffix, load_records, too_short
    from replay.cli.selection import Wanted, selected
    from twin_core.calibrate import calibrate as fit
    from twin_core.compiled import deadline_after
    from twin_core.files import write_text
    from twin_core.network.spec_io import load_spec

    check_suffix(out, (".json",))
    given = {"learning_rate": learning_rate, "window_s": window, "max_iterations": epochs, "patience": patience}
    training = {name: float(value) for name, value in given.items() if value is not None}
    if training and method != "neural-ode":
        raise click.UsageError("--learning-rate, --window, --epochs and --patience belong to --method neural-ode")
    until = deadline_after(deadline)
    wanted = Wanted(start, stop, samples, thin)
    spec = load_spec(spec_file)
    records = selected(spec, load_records(telemetry, spec, masking=not no_masking), wanted)
    with progress_bar("calibrating") as progress:
        model = fit(spec, records, method=method, loss=loss, deadline=until, training=training, progress=progress)
    write_text(out, to_json(model.to_json()))
    notify([*too_short(records), *model.summary["notices"]])
    if as_json:
        print_line(to_json({"out": str(out)} | model.summary).rstrip())
    else:
        _print_summary(model.summary, out)


def _print_summary(summary: dict[str, Any], out: Path) -> None:
    """Print the parameters with their uncertainty, the misfit of each sensor, and what the data cannot tell."""
    from replay.cli.console import print_line, print_table, short

    parameters = [
        [p["name"], short(p["mean"], 4), short(p["std"], 2), p.get("unit") or ""] for p in summary["parameters"]
    ]
    print_table("calibrated parameters", ["parameter", "mean", "std", "unit"], parameters)
    sensors = [[name, short(row["rmse_K"]), short(row["bias_K"], 2)] for name, row in summary["per_sensor"].items()]
    print_table("training misfit", ["sensor", "rmse K", "bias K"], sensors)
    if summary["status"] != "converged":
        print_line(summary["advice"])
    for words in summary.get("words", ()):
        print_line(words)
    print_line(f"wrote {out}")
