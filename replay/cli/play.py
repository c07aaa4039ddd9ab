"""``twin replay``: streams recordings into a running service."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from replay.cli.command import FILE, Command

if TYPE_CHECKING:
    from replay.player import Tally
    from replay.recording import Recording
    from service.client import TwinClient


@click.command(
    cls=Command,
    short_help="Stream recordings into a service.",
    example="twin replay orbits.mcap --url http://127.0.0.1:8000 --twin benchsat --rate 60",
)
@click.argument("files", metavar="FILE.mcap...", nargs=-1, required=True, type=FILE)
@click.option("--url", required=True, help="Where the service listens.")
@click.option("--twin", required=True, help="The twin's id.")
@click.option("--rate", default="max", show_default=True, help="Recorded seconds per second, or max.")
@click.option("--resume", is_flag=True, help="Leave out what the service already holds.")
@click.option("--map", "renames", multiple=True, metavar="TOPIC=CHANNEL", help="A topic that feeds another channel.")
@click.option("--ignore-others", is_flag=True, help="Leave out topics that feed no channel instead of refusing them.")
@click.option("--key", envvar="TWIN_API_KEY", help="API key of the service.  [default: TWIN_API_KEY]")
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
def replay(
    files: tuple[Path, ...],
    url: str,
    twin: str,
    rate: str,
    resume: bool,
    renames: tuple[str, ...],
    ignore_others: bool,
    key: str | None,
    as_json: bool,
) -> int:
    """Stream recordings into a running service, paced or as fast as it takes them.

    Exits with 1 if the service refused samples, because it holds others of the same time, or put some into quarantine,
    because they lie ahead of its clock.
    """
    from replay.cli.console import print_line, to_json
    from replay.source import load
    from service.client import TwinClient

    pace = _pace(rate)
    wanted = _renames(renames)
    check_url(url)
    recordings = load(files)
    with TwinClient(url, key) as client:
        tallies = [_send(r, client, twin, wanted, pace, resume, ignore_others) for r in recordings]
    counted = ("sent", "accepted", "duplicates", "rejected", "quarantined")
    outcome = {name: sum(getattr(tally, name) for tally in tallies) for name in counted}
    outcome |= {"last_time": tallies[-1].last_time}
    print_line(
        to_json(outcome).rstrip() if as_json else ", ".join(f"{name} {value}" for name, value in outcome.items())
    )
    return 1 if outcome["rejected"] or outcome["quarantined"] else 0


def _pace(rate: str) -> float | None:
    if rate == "max":
        return None
    try:
        value = float(rate)
    except ValueError:
        value = float("nan")
    if not 0.0 < value < float("inf"):
        raise click.UsageError(f"--rate must be a positive number or max (got '{rate}')")
    return value


def _renames(pairs: tuple[str, ...]) -> dict[str, str]:
    wrong = next((pair for pair in pairs if "=" not in pair), None)
    if wrong is not None:
        raise click.UsageError(f"--map must read TOPIC=CHANNEL (got '{wrong}')")
    return dict(pair.split("=", 1) for pair in pairs)


def check_url(url: str) -> None:
    """Refuse what is no address of a service."""
    if not url.startswith(("http://", "https://")) or len(url.split("//", 1)[1]) == 0:
        raise click.UsageError(f"--url must begin with http:// or https:// (got '{url}')")


def _send(
    recording: "Recording",
    client: "TwinClient",
    twin: str,
    renames: dict[str, str],
    rate: float | None,
    resume: bool,
    ignore_others: bool,
) -> "Tally":
    """Send one recording in the twin's channels and units, showing how far it got."""
    from replay.cli.console import progress_bar
    from replay.cli.recordings import convert_units
    from replay.errors import ReplayError
    from replay.mapping import apply_mapping, map_topics
    from replay.player import play
    from service.client import ApiError, Unreachable
    from twin_core.network.spec_io import load_spec

    try:
        detail = client.twin(twin)
    except (ApiError, Unreachable) as error:
        raise ReplayError(f"twin '{twin}': {error}") from error
    mapping = map_topics(list(recording.columns), detail.channels, renames, ignore_others=ignore_others)
    fitting = convert_units(apply_mapping(recording, mapping), load_spec(detail.specification), "the recording")
    begun_s = time.monotonic()

    def note(tally: "Tally") -> str:
        rate = tally.sent / max(time.monotonic() - begun_s, 1e-9)
        return f"{tally.sent:,} of {tally.total:,} samples, {rate:,.0f} per second"

    with progress_bar("replaying") as progress:
        return play(
            fitting,
            client,
            twin,
            rate=rate,
            resume=resume,
            progress=lambda tally: progress(tally.sent / max(tally.total, 1), note(tally)),
        )
