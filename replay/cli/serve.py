"""``twin serve``: the service."""

import os

import click

from replay.cli.command import Command


@click.command(cls=Command, short_help="Run the service and its dashboard.", example="twin serve --port 8000")
@click.option("--host", help="Address to listen on.  [default: TWIN_HOST, else 127.0.0.1]")
@click.option("--port", type=int, help="Port to listen on, 0 for a free one.  [default: TWIN_PORT, else 8000]")
@click.option("--effects", multiple=True, metavar="FILE.py...", help="Plug-ins with effects.  [default: TWIN_EFFECTS]")
def serve(host: str | None, port: int | None, effects: tuple[str, ...]) -> None:
    """Run the service and its dashboard until interrupted; TWIN_* environment variables hold its settings."""
    from replay.cli.console import print_line
    from service.monitoring.logs import start_logging
    from service.server import serve as run
    from service.settings import read_settings

    given = {"host": host, "port": port, "effects": os.pathsep.join(effects) or None}
    settings = read_settings(**{name: value for name, value in given.items() if value is not None})
    start_logging(settings.log_level)
    run(settings, on_ready=lambda url: print_line(f"listening on {url}"))
