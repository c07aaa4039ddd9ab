"""``twin close-loop``: from telemetry to a verdict, without a service."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from replay.cli.command import FILE, Command
from replay.cli.durations import DURATION, POSITIVE_DURATION
from replay.cli.effects import effects_option

if TYPE_CHECKING:
    from twin_core.closed_loop import ClosedLoop
    from twin_core.report.dossier import Moment


FOUND = "an undeclared effect was found and added"


@click.command(
    "close-loop",
    cls=Command,
    short_help="Find and add what the model lacks.",
    example="twin close-loop --spec sat.yaml --telemetry flight.csv --holdout 0.3 --out loop",
)
@click.option("--spec", "spec_file", type=FILE, help="Specification, YAML or JSON.")
@click.option(
    "--telemetry",
    multiple=True,
    metavar="FILE...",
    type=FILE,
    help="CSV or MCAP files, one per segment.",
)
@click.option("--fleet", type=FILE, metavar="DIR", help="Many at once: a folder each, with spec.yaml and telemetry.")
@click.option(
    "--executor", default="process", show_default=True, help="What computes a fleet: process, or dask://HOST:PORT."
)
@click.option("--holdout", type=float, help="Share of the time span kept back at the end.  [default: 0.3]")
@click.option(
    "--holdout-telemetry", multiple=True, metavar="FILE...", type=FILE, help="Separate files kept back instead."
)
@click.option(
    "--burn-in", type=DURATION, help="First seconds (or 6h, 1d) of each hold-out file that tell its initial state."
)
@click.option("--false-alarm-rate", default=0.01, show_default=True, type=float, help="Of findings on healthy records.")
@click.option("--deadline", type=POSITIVE_DURATION, help="Best answer after so many seconds (or 5min).")
@click.option("--no-masking", is_flag=True, help="Take every sample as a reading, frozen ones and spikes too.")
@click.option("--out", required=True, type=FILE, help="Folder for report.json, report.html and model.json.")
@click.option(
    "--flows-at",
    multiple=True,
    metavar="TIME[/TIME]",
    help="An instant or a phase of the training telemetry for the heat-flow map; may be repeated.",
)
@click.option("--author", default="", help="Who signs the report: printed on it.")
@click.option("--pdf", is_flag=True, help="Print the report too, as report.pdf; needs Chromium or Chrome.")
@effects_option
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def close_loop(
    spec_file: Path | None,
    telemetry: tuple[Path, ...],
    fleet: Path | None,
    executor: str,
    holdout: float | None,
    holdout_telemetry: tuple[Path, ...],
    burn_in: float | None,
    false_alarm_rate: float,
    deadline: float | None,
    no_masking: bool,
    out: Path,
    flows_at: tuple[str, ...],
    author: str,
    pdf: bool,
    as_json: bool,
) -> None:
    """Calibrate, find what the model lacks, add it, and measure the error on telemetry kept back.

    Exits with 0 whenever it reaches a verdict, also when the verdict is that no effect is supported; of a fleet, if every
    spacecraft does.
    """
    from replay.cli.console import notify, print_line, progress_bar, to_json
    from replay.cli.printing import as_pdf
    from replay.cli.recordings import check_apart, load_records
    from replay.cli.signed import document
    from twin_core.closed_loop import close_loop as run
    from twin_core.network.spec_io import load_spec

    _check(holdout, holdout_telemetry, burn_in, false_alarm_rate, out)
    if fleet is not None:
        if spec_file is not None or telemetry or holdout_telemetry:
            raise click.UsageError(
                "--fleet excludes --spec, --telemetry and --holdout-telemetry; each folder holds its own"
            )
        options = {"holdout": 0.3 if holdout is None else holdout, "false_alarm_rate": false_alarm_rate}
        options |= {} if deadline is None else {"deadline_s": deadline}
        _close_fleet(fleet, executor, out, options, masking=not no_masking, as_json=as_json)
        return
    if spec_file is None or not telemetry:
        raise click.UsageError("give --spec and --telemetry, or --fleet")
    spec = load_spec(spec_file)
    records = load_records(telemetry, spec, masking=not no_masking)
    held_out = load_records(holdout_telemetry, spec, masking=not no_masking)
    check_apart(records, held_out)
    with progress_bar("closing the loop") as progress:
        loop = run(
            spec,
            records,
            holdout=None if held_out else (0.3 if holdout is None else holdout),
            holdout_records=held_out or None,
            burn_in_s=burn_in,
            false_alarm_rate=false_alarm_rate,
            deadline_s=deadline,
            moments=[_moment(text) for text in flows_at],
            progress=progress,
        )
    loop.report["document"] = document(author, [spec_file, *telemetry, *holdout_telemetry])
    _save(loop, out)
    if pdf:
        as_pdf(out / "report.html", out / "report.pdf")
    of_records = [notice for record in (*records, *held_out) for notice in record.notices]
    notify(list(dict.fromkeys([*of_records, *loop.report["notices"]])))
    if as_json:
        print_line(to_json(loop.report).rstrip())
    else:
        print_report(loop.report)
        print_line(f"wrote {out}/report.html, {'report.pdf, ' if pdf else ''}report.json, model.json")


def _moment(text: str) -> "Moment":
    """Return an instant, or a phase written as ISO 8601 writes intervals, in the form of the telemetry."""
    ends = [part.strip() for part in text.split("/")]
    if len(ends) > 2 or not all(ends):
        raise click.UsageError(f"--flows-at must be TIME or TIME/TIME (got '{text}')")
    found: list[str | float] = []
    for end in ends:
        try:
            found.append(float(end))
        except ValueError:
            found.append(end)
    return found[0], found[-1]


def _check(
    holdout: float | None,
    holdout_telemetry: tuple[Path, ...],
    burn_in: float | None,
    false_alarm_rate: float,
    out: Path,
) -> None:
    """Refuse options that contradict each other, before anything is read."""
    if holdout is not None and holdout_telemetry:
        raise click.UsageError("--holdout and --holdout-telemetry exclude each other; give one of them")
    if holdout is not None and not 0.0 < holdout < 1.0:
        raise click.UsageError(f"--holdout must be between 0 and 1, exclusive (got {holdout:g})")
    if burn_in is not None and not holdout_telemetry:
        raise click.UsageError("--burn-in belongs to --holdout-telemetry")
    if burn_in is not None and not 0.0 <= burn_in < float("inf"):
        raise click.UsageError(f"--burn-in must be a number of seconds (got {burn_in:g})")
    if not 0.0 < false_alarm_rate < 0.5:
        raise click.UsageError(f"--false-alarm-rate must be between 0 and 0.5, exclusive (got {false_alarm_rate:g})")
    if out.exists() and not out.is_dir():
        raise click.UsageError(f"--out {out} is a file; name a folder")


def _save(loop: "ClosedLoop", out: Path) -> None:
    from replay.cli.console import to_json
    from twin_core.files import make_folder, write_text
    from twin_core.report.html import render

    make_folder(out)
    write_text(out / "model.json", to_json(loop.model.to_json()))
    write_text(out / "report.json", to_json(loop.report))
    write_text(out / "report.html", render(loop.report, loop.plots))


def _close_fleet(
    fleet: Path, executor: str, out: Path, options: dict[str, Any], *, masking: bool, as_json: bool
) -> None:
    """Close the loop on every folder of a fleet; click.ClickException where one failed."""
    from replay.cli.fleet import close_fleet

    if not re.fullmatch(r"process|dask://[^/]+:[0-9]+", executor):
        raise click.UsageError(f"--executor must be process or dask://HOST:PORT (got {executor})")
    reports = close_fleet(fleet, executor, out, options, masking=masking)
    _print_fleet(reports, out, as_json)
    _refuse_failed(reports)


def _refuse_failed(reports: dict[str, dict[str, Any]]) -> None:
    """Say on stderr which spacecraft failed, and why; click.ClickException if one did."""
    failed = {name: report["error"] for name, report in sorted(reports.items()) if "error" in report}
    for name, error in failed.items():
        click.echo(f"{name}: {' '.join(error.split())}", err=True)
    if failed:
        raise click.ClickException(f"{len(failed)} of {len(reports)} spacecraft failed: {', '.join(failed)}")


def _print_fleet(reports: dict[str, dict[str, Any]], out: Path, as_json: bool) -> None:
    """Print a line per spacecraft."""
    from replay.cli.console import print_line, print_table, short, to_json

    if as_json:
        print_line(to_json(reports).rstrip())
        return
    rows = []
    for name, report in sorted(reports.items()):
        if "error" in report:
            rows.append([name, report["error"][:80], "", ""])
        else:
            found = ", ".join(describe(finding) for finding in report["findings"]) or report["verdict"]
            rows.append([name, found, short(report["before"]["rmse_K"]), short(report["after"]["rmse_K"])])
    print_table("fleet", ["spacecraft", "found", "before K", "after K"], rows)
    print_line(f"wrote {out}/fleet.json, and report.html, report.json, model.json of each")


def print_report(report: dict[str, Any]) -> None:
    """Print the verdict, the findings, the held-out error before and after, and what the data cannot tell."""
    from replay.cli.console import print_line, print_table, short
    from twin_core.report.phrasing import ambiguities, headline, sentence

    print_line(f"{report['twin']}: {FOUND if report['findings'] else headline(report)}")
    for finding in report["findings"]:
        print_line(f"  {sentence(finding)}")
        print_line(f"  {describe(finding)}; log Bayes factor {short(finding['evidence']['log_bayes_factor'])}")
        for told in ambiguities(finding, describe):
            print_line(f"    {told[:1].lower()}{told[1:]}")
    before, after = report["before"], report["after"]
    rows = [["all sensors", short(before["rmse_K"]), short(after["rmse_K"])]]
    for sensor, scores in before["per_sensor"].items():
        rows.append([sensor, short(scores["rmse_K"]), short(after["per_sensor"][sensor]["rmse_K"])])
    print_table("held-out rmse", ["sensor", "before K", "after K"], rows)
    for words in report["words"]:
        print_line(words)


def describe(finding: Mapping[str, Any]) -> str:
    """Return an effect, its place and its parameters in one phrase."""
    from replay.cli.console import short

    places = [" - ".join(place) if isinstance(place, list) else place for place in finding["where"].values()]
    values = [
        f"{name} = {p['mean'] if isinstance(p['mean'], str) else short(p['mean'], 4)}"
        + (f" ± {short(p['std'], 2)}" if p["std"] is not None else "")
        for name, p in finding.get("parameters", {}).items()
        if isinstance(p["mean"], int | float | str)
    ]
    return f"{finding['effect']} at {', '.join(places)}" + (f" ({'; '.join(values)})" if values else "")
