"""``twin simulate``: the finite-element simulator."""

from pathlib import Path

import click

from replay.cli.command import FILE, Command


@click.command(
    cls=Command,
    short_help="Simulate orbits by finite elements.",
    example="twin simulate --scenario examples/scenarios/cross-section.yaml --out orbits.mcap",
)
@click.option("--scenario", required=True, type=FILE, help="Scenario, YAML or JSON.")
@click.option("--out", required=True, type=FILE, help="Recording to write, .mcap or .csv.")
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
def simulate(scenario: Path, out: Path, as_json: bool) -> None:
    """Simulate orbits of a spacecraft by finite elements and record its telemetry."""
    from replay.cli.console import print_line, progress_bar, to_json
    from replay.cli.recordings import check_suffix, save_record
    from twin_core.fem.scenario import load_scenario
    from twin_core.fem.simulate import simulate as run

    check_suffix(out)
    plan = load_scenario(scenario)
    with progress_bar("simulating") as progress:
        record = run(plan, progress).record
    units = {name: channel.unit for name, channel in plan.channels.items()}
    save_record(
        out, record, units, {"scenario": plan.scenario, "seed": str(plan.seed)}, {scenario.name: scenario.read_bytes()}
    )
    outcome = {"out": str(out), "samples": int(record.time_s.size), "channels": list(record.values)}
    print_line(
        to_json(outcome).rstrip()
        if as_json
        else f"{out}: {record.time_s.size} samples of {len(record.values)} channels"
    )
