"""``twin bridge``: keeps a twin and the products of a control room in step."""

import signal
from pathlib import Path
from typing import TYPE_CHECKING

import click

from replay.cli.command import FILE, Command

if TYPE_CHECKING:
    from replay.bridges.yamcs_gateway import YamcsGateway

_url = click.option("--url", required=True, help="Where Yamcs listens, such as http://127.0.0.1:8090.")
_instance = click.option("--instance", required=True, help="The Yamcs instance.")
_config = click.option("--config", required=True, type=FILE, help="Which parameter feeds which channel, YAML.")
_service = click.option(
    "--service", default="http://127.0.0.1:8000", show_default=True, help="Where the twin's service listens."
)
_key = click.option("--key", envvar="TWIN_API_KEY", help="API key of the service.  [default: TWIN_API_KEY]")
_user = click.option("--user", help="User of Yamcs; the password is read from YAMCS_PASSWORD.")
_json = click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")


@click.group(
    short_help="Bring a twin into Yamcs and other products of a control room.",
    epilog="\b\nExample:\n  twin bridge yamcs --url http://127.0.0.1:8090 --instance sat --config bridge.yaml",
)
def bridge() -> None:
    """Keep a twin and a control system in step."""


@bridge.command(
    cls=Command,
    short_help="Telemetry from Yamcs; forecasts, residuals and events back into it.",
    example="twin bridge yamcs --url http://127.0.0.1:8090 --instance sat --config bridge.yaml",
)
@_url
@_instance
@_config
@_service
@_key
@_user
@click.option("--processor", default="realtime", show_default=True, help="The processor to subscribe to.")
@click.option("--poll", default=1.0, show_default=True, type=click.FloatRange(0.05), help="Seconds between two looks.")
@click.option("--once", is_flag=True, help="End once both sides hold what the other one has now.")
@_json
def yamcs(
    url: str,
    instance: str,
    config: Path,
    service: str,
    key: str | None,
    user: str | None,
    processor: str,
    poll: float,
    once: bool,
    as_json: bool,
) -> int:
    """Feed a twin from Yamcs, and publish there what the twin knows, until interrupted.

    Exits with 1 if the service refused samples or put some into quarantine.
    """
    from dataclasses import asdict

    from replay.bridges.config import read_config
    from replay.cli.console import notify, print_line, to_json
    from replay.cli.play import check_url

    settings = read_config(config)
    check_url(service)
    check_url(url)
    _need("yamcs", "Yamcs' client", "yamcs")
    from replay.bridges.yamcs_bridge import YamcsBridge
    from service.client import TwinClient

    with TwinClient(service, key) as client:
        running = YamcsBridge(
            settings,
            lambda: _connected(url, instance, user, processor),
            client,
            service,
            lambda sentence: notify([sentence]),
            poll,
        )
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: running.stop())
        tally = running.run(once=once)
    outcome = asdict(tally)
    print_line(to_json(outcome).rstrip() if as_json else ", ".join(f"{k} {v}" for k, v in outcome.items()))
    return 1 if tally.rejected or tally.quarantined else 0


@bridge.command(
    cls=Command,
    short_help="Write the XTCE of what twin bridge yamcs publishes.",
    example="twin bridge xtce --config bridge.yaml --out thermal-twin.xml",
)
@_config
@_service
@_key
@click.option("--out", required=True, type=FILE, help="The XTCE file, for the instance's mission database.")
def xtce(config: Path, service: str, key: str | None, out: Path) -> None:
    """Write an XTCE file that declares every parameter that the bridge publishes, limits as alarms of the forecasts."""
    from replay.bridges.config import read_config
    from replay.cli.console import print_line
    from replay.cli.play import check_url
    from replay.errors import ReplayError
    from service.client import ApiError, TwinClient, Unreachable
    from twin_core.files import write_text

    settings = read_config(config)
    check_url(service)
    _need("yamcs", "Yamcs' client", "yamcs")
    from replay.bridges.yamcs_mdb import write_xtce
    from replay.bridges.yamcs_names import published_names
    from replay.wording import counted

    try:
        with TwinClient(service, key) as client:
            twin = client.twin(settings.twin)
    except (ApiError, Unreachable) as error:
        raise ReplayError(f"twin '{settings.twin}': {error}") from error
    write_text(out, write_xtce(settings, twin))
    print_line(f"wrote {out}: {counted(len(published_names(settings, twin)), 'parameter')} below {settings.root}")


@bridge.command(
    cls=Command,
    short_help="Read the mission's limits from Yamcs into a specification.",
    example=(
        "twin bridge limits --url http://127.0.0.1:8090 --instance sat --config bridge.yaml "
        "--spec sat.yaml --out sat-limits.yaml"
    ),
)
@_url
@_instance
@_config
@_user
@click.option("--spec", required=True, type=FILE, help="The specification.")
@click.option("--out", required=True, type=FILE, help="The specification with limits, .yaml or .json.")
def limits(url: str, instance: str, config: Path, user: str | None, spec: Path, out: Path) -> None:
    """Write the specification with the limits that the mission database gives its sensors' parameters.

    Warning and watch levels become yellow limits, critical, distress and severe ones red. Limits of other channels stay.
    """
    import yaml

    from replay.bridges.config import read_config
    from replay.cli.console import notify, print_line, to_json
    from replay.cli.play import check_url
    from twin_core.files import write_text
    from twin_core.network.spec_io import dump_spec, load_spec

    settings = read_config(config)
    check_url(url)
    document = dump_spec(load_spec(spec))
    _need("yamcs", "Yamcs' client", "yamcs")
    from replay.bridges.yamcs_mdb import read_limits

    with _connected(url, instance, user) as gateway:
        declared = gateway.declared([source.name for source in settings.parameters.values()])
    found, notices = read_limits(settings, document["channels"], declared)
    notify(notices)
    for channel, given in found.items():
        document["channels"][channel]["limits"] = given
    load_spec(document)  # limits that contradict each other are named before anything is written
    plain = (
        to_json(document) if out.suffix == ".json" else yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    )
    write_text(out, plain)
    print_line(f"wrote {out}: limits of {', '.join(found) if found else 'no channel'}")


@bridge.command(
    cls=Command,
    short_help="Samples, residuals and events to viewers of Foxglove, live.",
    example="twin bridge foxglove --twin benchsat --service http://127.0.0.1:8000 --port 8765",
)
@_service
@click.option("--twin", required=True, help="The twin's id.")
@_key
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--port", default=8765, show_default=True, type=click.IntRange(0, 65535), help="0 takes any free one.")
def foxglove(service: str, twin: str, key: str | None, host: str, port: int) -> None:
    """Serve a running twin to viewers of Foxglove by web socket, until interrupted.

    The web socket asks nobody for a key: whoever reaches it sees the twin's telemetry.
    """
    import asyncio

    from replay.cli.play import check_url

    check_url(service)
    _need("foxglove", "Foxglove's SDK", "foxglove")
    asyncio.run(_serve_foxglove(service, twin, key, host, port))


async def _serve_foxglove(service: str, twin: str, key: str | None, host: str, port: int) -> None:
    from replay.bridges.foxglove_server import FoxgloveServer
    from replay.cli.console import print_line
    from replay.cli.record import follow
    from replay.errors import ReplayError
    from replay.recorder import Recorder, topics_of
    from service.client import ApiError, AsyncTwinClient, Unreachable

    async with AsyncTwinClient(service, key) as client:
        try:
            head = await client.twin(twin)
            topics, units = topics_of(head)
            with FoxgloveServer(twin, topics, units, host, port) as server:
                recorder = Recorder(client, twin, server, service_url=service)
                await recorder.take_events()
                print_line(f"listening on {server.url}")
                await follow(recorder, head.seq, None)
        except (ApiError, Unreachable) as error:
            raise ReplayError(f"twin '{twin}': {error}") from error


def _need(module: str, what: str, extra: str) -> None:
    """Say what to install where a library is not."""
    from importlib.util import find_spec

    from replay.bridges.errors import BridgeError

    if find_spec(module) is None:
        raise BridgeError(f"this needs {what}: pip install 'thermal-twin[{extra}]'")


def _connected(url: str, instance: str, user: str | None, processor: str = "realtime") -> "YamcsGateway":
    import os

    from replay.bridges.yamcs_gateway import YamcsGateway

    return YamcsGateway(url, instance, processor, user, os.environ.get("YAMCS_PASSWORD"))
