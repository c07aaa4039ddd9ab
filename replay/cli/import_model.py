"""``twin import``: a model of another tool as a specification."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from replay.cli.command import FILE, Command
from replay.cli.durations import POSITIVE_DURATION

if TYPE_CHECKING:
    from twin_core.interchange.imported import Imported

FORMATS = ("xija", "esatan", "sinda")
_HEADER = re.compile(r"^\s*HEADER\s+\w", re.IGNORECASE | re.MULTILINE)
_PARTS = (".cc", ".k", ".hra")
"""Ends of the names of SINDA files that hold a model: nodes and conductors, radiation, heat rates."""


@click.command(
    "import",
    cls=Command,
    short_help="Turn a model of another tool into a specification.",
    example="twin import psmc_spec.json --channel 1pdeaat=T_box --hidden pin1at --out psmc.yaml",
)
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=FILE)
@click.option("--out", required=True, type=FILE, help="Specification to write, .yaml or .json.")
@click.option(
    "--format",
    "kind",
    type=click.Choice(FORMATS),
    help="What the file is.  [default: told by its name and content]",
)
@click.option(
    "--channel",
    "channels",
    multiple=True,
    metavar="NAME=COLUMN",
    help="Telemetry column of a component or node of the model.",
)
@click.option(
    "--constant", "constants", multiple=True, metavar="NAME=VALUE", help="Input that never changes (Xija models)."
)
@click.option("--hidden", multiple=True, metavar="NODE", help="Nodes without telemetry (Xija models).")
@click.option("--held", is_flag=True, help="Take every number as known; else what was fitted before is a guess.")
@click.option(
    "--by-submodel", is_flag=True, help="Calibrate a factor for the couplings of each pair of submodels (SINDA)."
)
@click.option(
    "--spread",
    type=click.FloatRange(min=1.0, min_open=True),
    default=1.1,
    show_default=True,
    help="Factor by which a fitted number may be off, one standard deviation (Xija models).",
)
@click.option(
    "--over-time", is_flag=True, help="Read the course of heat rates over the orbit, not their averages (SINDA)."
)
@click.option("--inputs", type=FILE, help="CSV to write: what the model says of heats that go over time.")
@click.option(
    "--duration", type=POSITIVE_DURATION, help="How long --inputs is: seconds, or 1d.  [default: the longest of them]"
)
@click.option("--skip-unknown", is_flag=True, help="Write what was understood, and list what was not.")
@click.option("--json", "as_json", is_flag=True, help="Print notes and refusals as JSON.")
def import_model(
    files: tuple[Path, ...],
    out: Path,
    kind: str | None,
    channels: tuple[str, ...],
    constants: tuple[str, ...],
    hidden: tuple[str, ...],
    held: bool,
    by_submodel: bool,
    spread: float,
    over_time: bool,
    inputs: Path | None,
    duration: float | None,
    skip_unknown: bool,
    as_json: bool,
) -> None:
    """Turn a Xija, ESATAN-TMS or SINDA/Thermal Desktop model into a specification.

    Whatever is not understood is one line that names the file and the line, and then nothing is written, but with
    --skip-unknown.
    """
    from replay.cli.console import notify, print_line, sizes, to_json
    from replay.wording import counted
    from twin_core.errors import SpecError
    from twin_core.network.spec_io import load_spec

    if out.suffix not in (".yaml", ".yml", ".json"):
        raise click.UsageError(f"--out {out} must end in .yaml or .json")
    texts = {file: _text(file) for file in files}
    kind = kind or _told(files[0], texts[files[0]])
    if kind != "sinda" and len(files) > 1:
        raise click.UsageError(f"{files[1]}: only a SINDA deck has several files")
    columns, values = _pairs(channels, "channel"), _pairs(constants, "constant")
    if over_time and kind != "sinda":
        raise click.UsageError("--over-time belongs to SINDA decks; other tools' arrays over time are always read")
    if by_submodel and (held or kind != "sinda"):
        raise click.UsageError("--by-submodel belongs to SINDA decks, without --held")
    found = _read(kind, texts, columns, values, hidden, held, spread, over_time, by_submodel)
    refused = list(dict.fromkeys(found.refused))  # a line of a loop is refused each time that it is unrolled
    if not found.data.get("nodes") and (kind == "sinda" or skip_unknown or not refused):
        raise SpecError(_without_nodes(kind, files))
    if refused and not skip_unknown:
        raise SpecError(
            f"{refused[0]}; {counted(len(refused), 'item was', 'items were')} not understood: --skip-unknown leaves them out",
            refused,
        )
    spec = load_spec(found.data)
    _write(out, found)
    if inputs is not None:
        _write_inputs(inputs, found, duration)
    beside = [f"{path}: lies beside the deck and was not given" for path in _others(files)] if kind == "sinda" else []
    told = {"notes": [*found.notes, *beside], "left_out": refused}
    if as_json:
        print_line(to_json({"twin": spec.twin, "nodes": len(spec.nodes), **told}).rstrip())
        return
    notify([*found.notes, *beside, *(f"left out: {line}" for line in refused)])
    print_line(f"wrote {out}: {sizes(spec)}")


def _text(file: Path) -> str:
    from twin_core.errors import SpecError

    try:
        return file.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise SpecError(f"{file}: cannot be read ({error.strerror or error})") from error


def _told(file: Path, text: str) -> str:
    """Return what a file is; SpecError if it is none of the models that can be read."""
    from twin_core.errors import SpecError

    if file.suffix == ".json":
        return "xija"
    if "$MODEL" in text[:100_000].upper():
        return "esatan"
    if _HEADER.search(text):
        return "sinda"
    raise SpecError(
        f"{file}: is no model that can be read: the JSON of Xija, an ESATAN-TMS deck ($MODEL ... $ENDMODEL), or SINDA "
        "files (HEADER NODE DATA ...) such as .cc, .k and .hra"
    )


def _without_nodes(kind: str, files: tuple[Path, ...]) -> str:
    """Return what to say of files that declare no node, such as the case file that a SINDA deck begins with."""
    names = ", ".join(map(str, files))
    if kind != "sinda":
        return f"{names}: declares no node"
    beside = " ".join(map(str, _others(files)))
    advice = (
        f"give the files beside it too: twin import {' '.join(map(str, files))} {beside} --out SPEC"
        if beside
        else ("give the files that it inserts too (.cc with nodes and conductors, .k, .hra)")
    )
    return f"{names}: part of a SINDA deck that declares no node itself; {advice}"


def _others(files: tuple[Path, ...]) -> list[Path]:
    """Return the parts of a SINDA deck that lie beside the first file and were not given."""
    parts = [path for path in files[0].parent.iterdir() if path.suffix in _PARTS and path not in files]
    return sorted(parts, key=lambda path: (_PARTS.index(path.suffix), path.name))


def _pairs(given: tuple[str, ...], option: str) -> dict[str, str]:
    for pair in given:
        if "=" not in pair:
            raise click.UsageError(f"--{option} {pair}: write it as NAME=...")
    return {pair.split("=", 1)[0]: pair.split("=", 1)[1] for pair in given}


def _read(
    kind: str,
    texts: dict[Path, str],
    channels: dict[str, str],
    constants: dict[str, str],
    hidden: tuple[str, ...],
    held: bool,
    spread: float,
    over_time: bool,
    by_submodel: bool,
) -> "Imported":
    file, text = next(iter(texts.items()))
    if kind == "xija":
        from twin_core.interchange.xija.specification import read_xija

        try:
            values = {name: float(value) for name, value in constants.items()}
        except ValueError as error:
            raise click.UsageError(f"--constant: {error}") from error
        return read_xija(text, str(file), channels=channels, constants=values, hidden=hidden, held=held, spread=spread)
    if constants or hidden:
        raise click.UsageError("--constant and --hidden belong to Xija models")
    if kind == "esatan":
        from twin_core.interchange.esatan import read_esatan

        return read_esatan(text, str(file), channels=channels, held=held)
    from twin_core.interchange.sinda import read_sinda

    decks = {str(name): deck for name, deck in texts.items()}
    return read_sinda(decks, channels=channels, held=held, over_time=over_time, by_submodel=by_submodel)


def _write_inputs(out: Path, found: "Imported", duration_s: float | None) -> None:
    from twin_core.errors import SpecError
    from twin_core.interchange.imported import over_time
    from twin_core.telemetry import Record
    from twin_core.telemetry_csv import write_columns

    if not found.courses:
        raise SpecError(f"{out}: the model has no heats that go over time")
    time_s, columns = over_time(found.courses, duration_s)
    write_columns(out, Record(time_s, columns), dict.fromkeys(columns, "W"))


def _write(out: Path, found: "Imported") -> None:
    import yaml

    from replay.cli.console import to_json
    from twin_core.files import write_text

    if out.suffix == ".json":
        write_text(out, to_json(found.data))
        return
    head = "".join(f"# {line}\n" for line in (*found.notes, *(f"left out: {line}" for line in found.refused)))
    write_text(
        out, head + yaml.safe_dump(found.data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    )
