"""``twin simulate``: the finite-element simulator."""

from pathlib import Path

import click

from replay.cli.command import FILE, Command
from replay.cli.durations import POSITIVE_DURATION


@click.command(
    cls=Command,
    short_help="Simulate orbits by finite elements.",
    example="twin simulate --scenario examples/scenarios/cross-section.yaml --out orbits.mcap",
)
@click.option("--scenario", required=True, type=FILE, help="Scenario, YAML or JSON.")
@click.option("--out", required=True, type=FILE, help="Recording to write, .mcap or .csv.")
@click.option(
    "--field-every", type=POSITIVE_DURATION, help="Keep the temperature field too, so often, such as 10min; .mcap only."
)
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
def simulate(scenario: Path, out: Path, field_every: float | None, as_json: bool) -> None:
    """Simulate orbits of a spacecraft by finite elements and record its telemetry."""
    from replay.cli.console import print_line, progress_bar, to_json
    from replay.cli.recordings import check_suffix, save_record
    from replay.wording import counted
    from twin_core.fem.film import Film
    from twin_core.fem.scenario import load_scenario
    from twin_core.fem.simulate import no_watch
    from twin_core.fem.simulate import simulate as run

    check_suffix(out)
    if field_every is not None and out.suffix != ".mcap":
        raise click.UsageError("--field-every needs a recording that ends in .mcap; CSV holds no fields")
    plan = load_scenario(scenario)
    film = None if field_every is None else Film(plan, field_every)
    with progress_bar("simulating") as progress:
        record = run(plan, progress, no_watch if film is None else film.take).record
    units = {name: channel.unit for name, channel in plan.channels.items()}
    metadata = {"scenario": plan.scenario, "seed": str(plan.seed)}
    save_record(out, record, units, metadata, {scenario.name: scenario.read_bytes()}, film)
    outcome = {"out": str(out), "samples": int(record.time_s.size), "channels": list(record.values)}
    print_line(
        to_json(outcome).rstrip()
        if as_json
        else f"{out}: {counted(record.time_s.size, 'sample')} of {counted(len(record.values), 'channel')}"
    )
