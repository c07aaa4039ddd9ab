"""``twin record``: writes the samples of a running twin to an MCAP file as they arrive."""

import asyncio
import contextlib
import signal
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from replay.cli.command import FILE, Command
from replay.cli.play import check_url

if TYPE_CHECKING:
    from replay.recorder import Recorder, Tally


@click.command(
    cls=Command,
    short_help="Record a running twin to an MCAP file.",
    example="twin record --url http://127.0.0.1:8000 --twin benchsat --out pass.mcap --duration 5400",
)
@click.option("--url", required=True, help="Where the service listens.")
@click.option("--twin", required=True, help="The twin's id.")
@click.option("--out", required=True, type=FILE, help="Recording to write, .mcap.")
@click.option("--start", help="Begin with the archive from this time on, or 'all' of it.  [default: now]")
@click.option("--duration", type=float, help="Seconds to record; 0 takes the archive alone.  [default: until Ctrl-C]")
@click.option("--key", envvar="TWIN_API_KEY", help="API key of the service.  [default: TWIN_API_KEY]")
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
def record(
    url: str, twin: str, out: Path, start: str | None, duration: float | None, key: str | None, as_json: bool
) -> None:
    """Record the samples, innovations and events of a running twin until Ctrl-C, a SIGTERM or the end of --duration.

    The recording outlives restarts of the service; the file appears when it ends.
    """
    from replay.cli.console import print_line, to_json
    from replay.cli.recordings import check_suffix
    from twin_core.errors import TelemetryError
    from twin_core.units import format_instant, parse_instant_ns

    check_url(url)
    try:
        start = start if start in (None, "all") else format_instant(parse_instant_ns(start))
    except TelemetryError as error:
        raise click.UsageError(f"--start: {error}") from error
    check_suffix(out, (".mcap",))
    if duration is not None and not 0.0 <= duration < float("inf"):
        raise click.UsageError(f"--duration must be a number of seconds of at least 0 (got {duration:g})")
    tally = asyncio.run(_record(url, twin, out, start, duration, key))
    outcome = asdict(tally)
    print_line(to_json(outcome).rstrip() if as_json else f"{out}: " + ", ".join(f"{k} {v}" for k, v in outcome.items()))


async def _record(
    url: str, twin: str, out: Path, start: str | None, duration_s: float | None, key: str | None
) -> "Tally":
    from replay.cli.console import progress_bar, to_json
    from replay.errors import ReplayError
    from replay.mcap_writer import McapWriter
    from replay.recorder import Recorder, topics_of
    from service.client import ApiError, AsyncTwinClient, Unreachable

    async with AsyncTwinClient(url, key) as client:
        try:
            head = await client.twin(twin)
        except (ApiError, Unreachable) as error:
            raise ReplayError(f"twin '{twin}': {error}") from error
        topics, units = topics_of(head)
        declared = {"specification.json": to_json(head.specification).encode()}
        with (
            progress_bar("recording") as progress,
            McapWriter(out, topics, units, {"twin": twin}, attachments=declared, keep=True) as writer,
        ):
            recorder = Recorder(client, twin, writer, lambda tally: progress(0.0, f"{tally.samples} samples"), url)
            if start is not None:
                await recorder.take_archive(None if start == "all" else start)
            if duration_s != 0.0:
                await follow(recorder, head.seq, duration_s)
    return recorder.tally


async def follow(recorder: "Recorder", after_seq: int, duration_s: float | None) -> None:
    """Record until time is up or the process is asked to end."""
    task = asyncio.create_task(recorder.follow(after_seq))
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    try:
        with contextlib.suppress(asyncio.CancelledError, TimeoutError):
            await asyncio.wait_for(task, duration_s)
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(number)
