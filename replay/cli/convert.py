"""``twin convert``: files that operators have become telemetry files."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from replay.cli.command import FILE, Command

if TYPE_CHECKING:
    from replay.recording import Recording

FORMATS = ("csv", "parquet", "ccsds", "frames")
SCALES = ("utc", "tai", "gps", "tt")


@click.command(
    cls=Command,
    short_help="Turn exports, packets and frames into telemetry files.",
    example="twin convert export.csv --spec sat.yaml --out telemetry.csv",
)
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=FILE)
@click.option("--out", required=True, type=FILE, help="Telemetry file to write, .csv or .mcap.")
@click.option("--format", "kind", type=click.Choice(FORMATS), help="Format of the files.  [default: told by the name]")
@click.option(
    "--spec", type=FILE, help="Specification: names and units become those of its channels, others are left out."
)
@click.option(
    "--map", "renames", multiple=True, metavar="NAME=CHANNEL", help="A column or parameter that feeds a channel."
)
@click.option("--unit", "units", multiple=True, metavar="NAME=UNIT", help="Unit of a column that states none.")
@click.option("--time", "time_name", metavar="NAME", help="Column, parameter or member that is the time.")
@click.option("--time-scale", "scale", type=click.Choice(SCALES), help="Scale of times that do not state theirs.")
@click.option("--epoch", help="What numbers count from: unix, gps, tai, j2000, or a time of --time-scale.")
@click.option(
    "--time-unit", default="s", show_default=True, type=click.Choice(("s", "ms", "us", "ns")), help="Of numbers."
)
@click.option("--xtce", type=FILE, help="XTCE that describes the packets.")
@click.option("--container", help="Container of the XTCE to begin at.  [default: CCSDSPacket]")
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
def convert(
    files: tuple[Path, ...],
    out: Path,
    kind: str | None,
    spec: Path | None,
    renames: tuple[str, ...],
    units: tuple[str, ...],
    time_name: str | None,
    scale: str | None,
    epoch: str | None,
    time_unit: str,
    xtce: Path | None,
    container: str | None,
    as_json: bool,
) -> None:
    """Turn FILEs, of one format, into one telemetry file in UTC.

    Reads CSV exports such as those of Yamcs, Parquet, CCSDS packets through XTCE, and frames as JSON. Units and time scales are
    never guessed: what a file does not state is asked for by name.
    """
    from replay.bridges.convert import Wish, read
    from replay.bridges.time_scales import Stated
    from replay.cli.console import notify, print_line, to_json
    from replay.cli.play import _renames
    from replay.cli.recordings import check_suffix
    from replay.wording import counted

    check_suffix(out)
    wish = Wish(kind, time_name, Stated(scale, epoch, time_unit), xtce, container)
    given = _pairs(units, "--unit", "NAME=UNIT")
    parts = [read(path, wish) for path in files]
    whole = _joined(parts, given)
    notices = list(whole.notices)
    if spec is not None:
        whole, said = _fitted(whole, spec, _renames(renames))
        notices += said
    elif renames:
        whole = _renamed(whole, _renames(renames))
    notify(notices)
    _write(out, whole)
    outcome = {"out": str(out), "samples": len(whole), "channels": list(whole.columns), "units": dict(whole.units)}
    outcome |= {"notices": notices}
    named = ", ".join(f"{name} ({whole.units.get(name, 'unit not stated')})" for name in whole.columns)
    print_line(to_json(outcome).rstrip() if as_json else f"{out}: {counted(len(whole), 'sample')} of {named}")


def _pairs(pairs: tuple[str, ...], flag: str, form: str) -> dict[str, str]:
    wrong = next((pair for pair in pairs if "=" not in pair), None)
    if wrong is not None:
        raise click.UsageError(f"{flag} must read {form} (got '{wrong}')")
    return dict(pair.split("=", 1) for pair in pairs)


def _joined(parts: "list[Recording]", given: dict[str, str]) -> "Recording":
    """Return several files as one, with the units that they and the user state; BridgeError where these contradict."""
    import numpy as np

    from replay.bridges.errors import BridgeError
    from replay.recording import Recording, align

    units: dict[str, str] = {}
    for part in parts:
        for name, unit in part.units.items():
            if units.setdefault(name, unit) != unit:
                raise BridgeError(f"'{name}' is in {units[name]} in one file, in {unit} in another")
    names = dict.fromkeys(name for part in parts for name in part.columns)
    for name, unit in given.items():
        if name not in names:
            raise BridgeError(f"--unit: no column is called '{name}' ({', '.join(list(names)[:8])})")
        if units.setdefault(name, unit) != unit:
            raise BridgeError(f"--unit says {unit} of '{name}', the file {units[name]}")
    series = {}
    for name in names:
        held = [(p.time_ns, p.columns[name]) for p in parts if name in p.columns]
        times, values = np.concatenate([t for t, _ in held]), np.concatenate([v for _, v in held])
        series[name] = times[~np.isnan(values)], values[~np.isnan(values)]
    whole = align(series)
    notices = tuple(notice for part in parts for notice in part.notices)
    return Recording(whole.time_ns, whole.columns, units, {}, (*notices, *whole.notices))


def _fitted(recording: "Recording", spec: Path, renames: dict[str, str]) -> "tuple[Recording, list[str]]":
    """Return a recording in the channels and units of a specification; every misfit is told by name, all at once."""
    from replay.bridges.errors import BridgeError
    from replay.bridges.units import conversion
    from replay.mapping import apply_mapping, map_topics
    from replay.recording import Recording
    from replay.wording import counted
    from twin_core.network.spec_io import load_spec

    channels = load_spec(spec).channels
    mapping = map_topics(list(recording.columns), list(channels), renames, ignore_others=True)
    named = apply_mapping(recording, mapping)
    columns, units, faults = {}, {}, []
    for name, column in named.columns.items():
        wanted, stated = channels[name].unit, named.units.get(name)
        convert = conversion(stated, wanted)
        if convert is None:
            source = next(topic for topic, channel in mapping.items() if channel == name)
            said = f"is in {stated}" if stated else f"states no unit (--unit '{source}=UNIT')"
            faults.append(f"'{source}' {said}, channel '{name}' is in {wanted}")
            continue
        columns[name] = convert.factor * column + convert.offset
        if wanted is not None:
            units[name] = wanted
    if faults:
        raise BridgeError("; ".join(faults))
    others = [topic for topic in recording.columns if topic not in mapping]
    lacking = [name for name in channels if name not in columns and not name.startswith("orbit.")]
    unused = counted(len(others), "column feeds no channel and is", "columns feed no channel and are")
    told = [f"{unused} left out: {', '.join(others[:8])}"] if others else []
    told += [f"{counted(len(lacking), 'channel')} without telemetry: {', '.join(lacking)}"] if lacking else []
    return Recording(named.time_ns, columns, units), told


def _renamed(recording: "Recording", renames: dict[str, str]) -> "Recording":
    from replay.bridges.errors import BridgeError
    from replay.recording import Recording

    unknown = next((name for name in renames if name not in recording.columns), None)
    if unknown is not None:
        raise BridgeError(f"--map: no column is called '{unknown}' ({', '.join(list(recording.columns)[:8])})")
    columns = {renames.get(name, name): column for name, column in recording.columns.items()}
    if len(columns) != len(recording.columns):
        raise BridgeError("--map: two columns would have the same name")
    units = {renames.get(name, name): unit for name, unit in recording.units.items()}
    return Recording(recording.time_ns, columns, units)


def _write(out: Path, recording: "Recording") -> None:
    """Write a recording in its own units, CSV to the microsecond or MCAP."""
    import csv

    import numpy as np

    from replay.mcap_io import write_mcap
    from twin_core.files import replacing

    if out.suffix == ".mcap":
        write_mcap(out, recording.time_ns, recording.columns, recording.units, {"dated": "true"})
        return
    stamps = np.datetime_as_string(recording.time_us.astype("datetime64[us]"), unit="us")
    with replacing(out) as partial, partial.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", *recording.columns])
        columns = [column.tolist() for column in recording.columns.values()]
        for stamp, *row in zip(stamps.tolist(), *columns, strict=True):
            writer.writerow([f"{stamp}Z", *("" if value != value else repr(value) for value in row)])
