"""``twin init``, ``twin check`` and ``twin show``: a first specification, whether one holds, and what a model says."""

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from replay.cli.command import FILE, Command

if TYPE_CHECKING:
    from twin_core.calibrate import CalibratedModel
    from twin_core.network.spec import TwinSpec
    from twin_core.telemetry import Record

MOST_LEVELS = 6
"""An auxiliary column that takes no more values than this is a state."""


@click.command(
    cls=Command,
    short_help="Write a first specification from telemetry.",
    example="twin init flight.csv --out sat.yaml",
)
@click.argument("telemetry", type=FILE)
@click.option("--out", required=True, type=FILE, help="Specification to write; an existing file stays.")
@click.option("--sink", default="space", show_default=True, help="Name of the boundary that every node loses heat to.")
def init(telemetry: Path, out: Path, sink: str) -> None:
    """Write a specification with a node for every temperature column of a CSV file, to be edited.

    Columns are told apart by name and values: temperatures (K or degC), powers in W, and states or angles.
    """
    import yaml

    from replay.cli.console import notify, print_line
    from replay.wording import counted
    from twin_core.errors import SpecError
    from twin_core.files import write_text
    from twin_core.network.spec_io import load_spec

    if out.exists():
        raise SpecError(f"{out}: exists already; name another file")
    document, remarks = _drafted(telemetry, sink)
    load_spec(document)
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110)
    head = f"# Drafted by twin init from {telemetry.name}: what is joined to what, and where heat goes in, is yours to say.\n"
    write_text(out, head + text)
    notify(remarks)
    print_line(
        f"wrote {out}: {counted(len(document['nodes']), 'node')}; edit it, then: twin check {out} --telemetry {telemetry}"
    )


def _drafted(telemetry: Path, sink: str) -> tuple[dict[str, Any], list[str]]:
    """Return the draft of a specification and remarks on the columns."""
    import numpy as np
    import pandas as pd

    from twin_core.errors import TelemetryError
    from twin_core.interchange.imported import name_of, twin_id

    try:
        table = pd.read_csv(telemetry)
    except (OSError, ValueError) as error:
        raise TelemetryError(f"{telemetry}: cannot be read as CSV ({error})") from error
    if table.shape[1] < 2 or table.columns[0] not in ("time", "time_s"):
        raise TelemetryError(f"{telemetry}: the first column must be 'time' or 'time_s', others the channels")
    channels: dict[str, Any] = {}
    remarks = []
    for name in table.columns[1:]:
        column = pd.to_numeric(table[name], errors="coerce").to_numpy(dtype=float)
        column = column[np.isfinite(column)]
        if column.size == 0 or name_of(name) != name:
            remarks.append(
                f"column '{name}' {'has no numbers' if column.size == 0 else 'has no valid name'} and is left out"
            )
            continue
        channels[name] = _channel(name, column)
    sensors = [name for name, channel in channels.items() if channel["kind"] == "temperature"]
    if not sensors:
        raise TelemetryError(f"{telemetry}: no column looks like a temperature; name them like T_box or box_degC")
    nodes = [{"id": _node_id(name), "sensor": name} for name in sensors]
    outward = [{"between": [node["id"], sink]} for node in nodes]
    chain = [{"between": [a["id"], b["id"]]} for a, b in pairwise(nodes)]
    loads: list[dict[str, Any]] = []
    for name, channel in channels.items():
        if channel["kind"] == "power":
            loads.append({"channel": name, "node": nodes[0]["id"]})
            remarks.append(f"channel '{name}' heats '{nodes[0]['id']}' in this draft: say where it really goes")
    document = {
        "twin": twin_id(telemetry.stem),
        "boundaries": {sink: {"guess_K": 260}},
        "channels": channels,
        "nodes": nodes,
        "conductors": [*chain, *outward],
    }
    return document | ({"loads": loads} if loads else {}), remarks


def _node_id(channel: str) -> str:
    """Return a name for the node that a channel reads: the channel's, without what says that it is a temperature."""
    import re

    short = re.sub(r"^(T|temp|temperature)_|_(degC|K|C|degK|temp|temperature)$", "", channel, flags=re.IGNORECASE)
    return f"{short}_node" if short == channel or not short[:1].isalpha() else short


def _channel(name: str, column: Any) -> dict[str, Any]:
    """Return what a column most likely is."""
    import re

    import numpy as np

    low, high = float(column.min()), float(column.max())
    if re.search(r"(^T_|^T\d|temp|degC$|_C$|_K$)", name, re.IGNORECASE) and -273.0 < low and high < 1000.0:
        kelvin = bool(re.search(r"_K$", name)) or (low > 150.0 and not re.search(r"degC$|_C$", name))
        return {"kind": "temperature", "unit": "K" if kelvin else "degC"}
    if re.search(r"(^Q|^P_|power|_W$|heater)", name, re.IGNORECASE):
        return {"kind": "power", "unit": "W"}
    levels = np.unique(column).size <= MOST_LEVELS
    return {"kind": "auxiliary"} | ({"levels": True} if levels else {})


@click.command(
    cls=Command,
    short_help="Say what is wrong with a specification.",
    example="twin check examples/platform.yaml",
)
@click.argument("spec", type=FILE)
@click.option("--telemetry", multiple=True, metavar="FILE...", type=FILE, help="Whether these fit to it, too.")
@click.option("--json", "as_json", is_flag=True, help="Print problems and doubts as JSON.")
def check(spec: Path, telemetry: tuple[Path, ...], as_json: bool) -> None:
    """Say everything that is wrong with a specification at once, one line each, and what is likely to be a mistake.

    Exits with 0 where nothing is wrong, 1 where something is. Doubts, which are likely mistakes, are counted at the end.
    """
    from replay.cli.console import print_line, sizes, to_json
    from replay.cli.recordings import load_records, too_short
    from replay.wording import counted
    from twin_core.errors import SpecError, TwinError
    from twin_core.network.doubts import isolated
    from twin_core.network.spec_io import load_spec, read_mapping

    read_mapping(spec)  # a file that is no mapping is bad input, not an answer
    problems: list[str] = []
    doubts: list[str] = []
    known: TwinSpec | None = None
    try:
        known = load_spec(spec)
    except SpecError as error:
        problems = list(error.problems or [str(error)])
    if known is not None:
        doubts = list(isolated(known))
        records: list[Record] = []
        for path in telemetry:
            try:
                records += load_records([path], known)
            except TwinError as error:
                problems.append(str(error))
        notices = [notice for record in records for notice in record.notices]
        doubts = list(dict.fromkeys([*doubts, *notices, *too_short(records)]))
    if as_json:
        print_line(to_json({"valid": not problems, "problems": problems, "doubts": doubts}).rstrip())
    else:
        for line in problems:
            print_line(f"{spec}: {line}" if not line.startswith(str(spec)) else line)
        for line in doubts:
            print_line(f"doubt: {line}")
        if known is not None and not problems:
            state = f"{counted(len(doubts), 'doubt')}, listed above" if doubts else "in order"
            print_line(f"{known.twin}: {state}; {sizes(known)}")
    if problems:
        raise click.exceptions.Exit(1)


@click.command(cls=Command, short_help="Print what a model file says.", example="twin show model.json")
@click.argument("model", type=FILE)
@click.option("--json", "as_json", is_flag=True, help="Print the parameters and effects as JSON.")
def show(model: Path, as_json: bool) -> None:
    """Print a calibrated model: what was added to it, and every parameter with its uncertainty."""
    from replay.cli.console import print_line, print_table, short, sizes, to_json
    from replay.cli.models import load_model

    found = load_model(model)
    rows = found.summary.get("parameters", [])
    if as_json:
        effects = [str(effect.label) for effect in found.effects]
        print_line(to_json({"twin": found.spec.twin, "effects": effects, "parameters": rows}).rstrip())
        return
    print_line(f"{found.spec.twin}: {sizes(found.spec)}")
    for effect in found.effects:
        values = ", ".join(f"{name} = {short(value, 4)}" for name, value in effect.values.items())
        print_line(f"  added: {effect.label} ({values})")
    _print_parameters(found, print_table, short)


def _print_parameters(model: "CalibratedModel", print_table: Any, short: Any) -> None:
    told = {row["name"]: row for row in model.summary.get("parameters", [])}
    units = {p.name: p.unit for p in model.network().parameters.parameters}
    rows = []
    for name, value in model.values.items():
        row = told.get(name, {})
        std = row.get("std")
        state = "known" if row.get("held", True) else "identified" if row.get("identified", True) else "not identified"
        rows.append(
            [name, short(value, 4), "" if std is None or state == "known" else short(std, 2), units[name], state]
        )
    print_table("parameters", ["name", "value", "±", "unit", ""], rows)
