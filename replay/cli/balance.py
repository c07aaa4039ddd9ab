"""``twin balance``: the temperatures at which a declared network is in balance."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from replay.cli.command import FILE, Command

if TYPE_CHECKING:
    from twin_core.network.spec import TwinSpec
    from twin_core.telemetry import Record

START_K = 290.0


@click.command(
    cls=Command,
    short_help="Print the steady state of a specification.",
    example="twin balance examples/platform.yaml --set T_bus=20 --set Q_box=20",
)
@click.argument("spec", type=FILE)
@click.option(
    "--set",
    "given",
    multiple=True,
    metavar="CHANNEL=VALUE",
    help="An input or boundary channel, in its own unit; else 0.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the temperatures in K as JSON.")
def balance(spec: Path, given: tuple[str, ...], as_json: bool) -> None:
    """Print the temperature of every node at which its heats are in balance, at the values and guesses of SPEC.

    Exits with 1 where there is no such state.
    """
    import numpy as np

    from replay.cli.console import print_line, print_table, to_json
    from twin_core.constants import ZERO_CELSIUS_K
    from twin_core.network.model import build_network
    from twin_core.network.spec_io import load_spec
    from twin_core.simulate.steady import steady_state

    known = load_spec(spec)
    network = build_network(known)
    found = steady_state(network, np.full(len(network.nodes), START_K), _inputs(known, given))
    states = dict(zip(network.nodes, found.tolist(), strict=True))
    declared = {node.id: states[node.id] for node in known.nodes}
    if as_json:
        print_line(to_json({"twin": known.twin, "temperature_K": declared}).rstrip())
        return
    rows = [[name, f"{t:.2f}", f"{t - ZERO_CELSIUS_K:.2f}"] for name, t in declared.items()]
    print_table("in balance", ["node", "K", "degC"], rows)


def _inputs(spec: "TwinSpec", given: tuple[str, ...]) -> "Record":
    """Return what was given, and zero for the other inputs, as a record of two instants."""
    import numpy as np

    from twin_core.telemetry import Record
    from twin_core.units import to_si

    values = {}
    for pair in given:
        name, _, text = pair.partition("=")
        if name not in spec.driving_channels:
            known = ", ".join(sorted(spec.driving_channels)) or "none"
            raise click.UsageError(f"--set {pair}: '{name}' is no input or boundary channel (known: {known})")
        try:
            values[name] = float(text)
        except ValueError as error:
            raise click.UsageError(f"--set {pair}: write it as {name}=NUMBER") from error
    for name, boundary in spec.boundaries.items():
        if boundary.channel is not None and boundary.channel not in values:
            raise click.UsageError(f"boundary '{name}' needs --set {boundary.channel}=TEMPERATURE")
    columns = {
        name: to_si(np.full(2, values.get(name, 0.0)), spec.channels[name].unit) for name in spec.driving_channels
    }
    return Record(np.array([0.0, 1.0]), columns, 0)
