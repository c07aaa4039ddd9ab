"""``twin correlate``: one model against several phases of a test, at rest and transient."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from replay.cli.command import FILE, Command
from replay.cli.durations import POSITIVE_DURATION

if TYPE_CHECKING:
    from twin_core.calibrate.phases import Phase
    from twin_core.network.spec import TwinSpec
    from twin_core.telemetry import Record

PHASE = "phase"
"""The column of a file of balance phases that names them."""


@click.command(
    cls=Command,
    short_help="Fit one model to balance phases and transients at once.",
    example="twin correlate --spec tvac.yaml --steady balance.csv --transient cooldown.csv --out correlation",
)
@click.option("--spec", "spec_file", required=True, type=FILE, help="Specification, YAML or JSON.")
@click.option(
    "--steady",
    multiple=True,
    metavar="FILE...",
    type=FILE,
    help="CSV files of balance phases: a row per phase, a column 'phase', one per channel.",
)
@click.option(
    "--transient", multiple=True, metavar="FILE...", type=FILE, help="CSV or MCAP files, each a phase of its own."
)
@click.option(
    "--loss",
    default="squared",
    show_default=True,
    type=click.Choice(["squared", "huber"]),
    help="huber for readings with outliers.",
)
@click.option(
    "--free",
    type=click.IntRange(min=1),
    metavar="N",
    help="Vary the N parameters that the sensors tell most of; the others keep their guesses.  [default: all]",
)
@click.option("--no-masking", is_flag=True, help="Take every sample as a reading, frozen ones and spikes too.")
@click.option("--deadline", type=POSITIVE_DURATION, help="Best answer after so many seconds (or 5min).")
@click.option("--out", required=True, type=FILE, help="Folder for report.json, report.html and model.json.")
@click.option("--author", default="", help="Who signs the report: printed on it.")
@click.option("--pdf", is_flag=True, help="Print the report too, as report.pdf; needs Chromium or Chrome.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def correlate(
    spec_file: Path,
    steady: tuple[Path, ...],
    transient: tuple[Path, ...],
    loss: str,
    free: int | None,
    no_masking: bool,
    deadline: float | None,
    out: Path,
    author: str,
    pdf: bool,
    as_json: bool,
) -> None:
    """Correlate a model with thermal balance phases and transients at once, and say where it meets the criteria.

    A phase at rest counts as much as the longest transient. Exits with 0 whether the criteria are met or not.
    """
    from replay.cli.console import notify, print_line, progress_bar, to_json
    from replay.cli.printing import as_pdf
    from replay.cli.recordings import load_records
    from replay.cli.signed import document
    from twin_core.calibrate.phases import Phase
    from twin_core.calibrate.phases import correlate as run
    from twin_core.compiled import deadline_after
    from twin_core.files import make_folder, write_text
    from twin_core.network.spec_io import load_spec
    from twin_core.report.dossier import limits, provenance, sensitivity
    from twin_core.report.html import render

    if not (steady or transient):
        raise click.UsageError("give --steady or --transient files")
    if out.exists() and not out.is_dir():
        raise click.UsageError(f"--out {out} is a file; name a folder")
    stop = deadline_after(deadline)
    spec = load_spec(spec_file)
    flown = load_records(transient, spec, masking=not no_masking)
    phases = [phase for path in steady for phase in balance_phases(path, spec, flown)]
    phases += [Phase(Path(record.name).stem, record, False) for record in flown]
    with progress_bar("correlating") as progress:
        found = run(
            spec,
            phases,
            loss="huber" if loss == "huber" else "squared",
            most_free=free,
            deadline=stop,
            progress=progress,
        )
    report = found.report
    report["sensitivity"] = sensitivity(found.calibration)
    report["provenance"] = provenance(spec, [phase.record for phase in phases])
    for row, phase in zip(report["provenance"]["telemetry"], phases, strict=True):
        row["steady"] = phase.steady
    report["document"] = document(author, [spec_file, *steady, *transient])
    drawn = limits(spec, found.model.noise_K)
    plots = {"criteria": spec.criteria.model_dump(), "phases": found.plots, "limits": drawn}
    make_folder(out)
    write_text(out / "model.json", to_json(found.model.to_json()))
    write_text(out / "report.json", to_json(report))
    write_text(out / "report.html", render(report, plots))
    if pdf:
        as_pdf(out / "report.html", out / "report.pdf")
    notify(report["notices"])
    if as_json:
        print_line(to_json(report).rstrip())
        return
    _print(report)
    print_line(f"wrote {out}/report.html, {'report.pdf, ' if pdf else ''}report.json, model.json")


def balance_phases(path: Path, spec: "TwinSpec", transients: "list[Record]") -> "list[Phase]":
    """Return the phases at rest of a CSV file, each dated as its ``time`` says, or as the first transient begins."""
    from twin_core.calibrate.phases import at_rest, weight_of
    from twin_core.csv_table import open_table
    from twin_core.errors import TelemetryError
    from twin_core.telemetry_csv import refuse_implausible
    from twin_core.units import parse_instant_ns

    table = open_table(path)
    if PHASE not in table.header:
        raise TelemetryError(f"{path}: has no column '{PHASE}' that names its rows")
    names = table.texts(PHASE)
    columns = table.numbers([name for name in table.header if name in spec.channels])
    for channel, column in columns.items():
        refuse_implausible(table, channel, spec.channels[channel], column)
    dates = table.texts("time") if "time" in table.header else [""] * len(names)
    dated = bool(transients) and transients[0].epoch_ns is not None
    found = []
    for row, (name, date) in enumerate(zip(names, dates, strict=True)):
        if not name:
            raise TelemetryError(f"{path}: line {int(table.line[row])}: column '{PHASE}' is empty; name the phase")
        epoch_ns = parse_instant_ns(date) if date else transients[0].epoch_ns if dated else None
        values = {channel: float(column[row]) for channel, column in columns.items()}
        found.append(at_rest(spec, name, values, samples=weight_of(transients), epoch_ns=epoch_ns))
    return found


def _print(report: dict[str, Any]) -> None:
    from replay.cli.console import print_line, print_table, short
    from twin_core.report.phrasing import headline

    print_line(f"{report['twin']}: {headline(report)}")
    rows = []
    for phase in report["phases"]:
        before, after = phase["before"], phase["after"]
        what = "at rest" if phase["steady"] else "transient"
        figures = [before.get("rmse_K"), after.get("rmse_K"), after.get("bias_K"), after.get("max_abs_K")]
        rows.append([phase["phase"], what, *map(short, figures), "met" if after.get("met") else "not met"])
    print_table("phases", ["phase", "", "declared K", "correlated K", "mean K", "largest K", "criteria"], rows)
    parameters = [
        [
            p["name"],
            short(p["declared"], 4),
            short(p["corrected"]["mean"], 4),
            short(p["corrected"]["std"], 2),
            p["unit"],
            "identified" if p["identified"] else "not identified",
        ]
        for p in report["parameters"]
        if p["identified"] is not None
    ]
    print_table("parameters", ["parameter", "declared", "correlated", "±", "unit", ""], parameters)
    for words in report["words"]:
        print_line(words)
