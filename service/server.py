"""The running server: the application behind uvicorn, shut down without losing what was acknowledged."""

import asyncio
import contextlib
import gc
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable

import uvicorn

from service.app import create_app
from service.http.protocol import patient
from service.monitoring import tracing
from service.settings import Settings, unknown_variables
from service.store.database import Database
from service.workbench.interface import MakeWorkbench
from twin_core.errors import TwinError

log = logging.getLogger("service")

SHUTDOWN_S = 10
SWITCH_S = 0.001
"""The writer needs the interpreter for a moment after each call of SQLite; by default it might wait 5 ms each time."""


class ServerError(TwinError):
    """The server cannot start."""


def serve(
    settings: Settings,
    on_ready: Callable[[str], None] | None = None,
    workbench: MakeWorkbench | None = None,
) -> None:
    """Serve until interrupted.

    Parameters
    ----------
    settings
        Where to listen and what to use; port 0 picks a free one.
    on_ready
        Called with the URL once the service answers.
    workbench
        What makes whoever does the science; ``twin_core`` with the plug-ins of the settings by default.

    Raises
    ------
    ServerError, StoreError, PluginError
        If the address, the database or a plug-in cannot be used.
    """
    for name in unknown_variables(os.environ):
        log.warning("an unknown setting is ignored", extra={"variable": name})
    if settings.effect_files:
        from twin_core.effects import load_effects

        load_effects(settings.effect_files)  # what is wrong with one is said before anything starts
    if settings.traces_url:
        try:
            tracing.start(settings.traces_url)
        except ModuleNotFoundError as error:
            raise ServerError("TWIN_TRACES_URL needs OpenTelemetry: pip install 'thermal-twin[traces]'") from error
    listener = _listen(settings)
    database = Database(settings.database)
    host, port = listener.getsockname()[:2]
    app = create_app(settings, database, workbench)
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        http=patient(settings.body_timeout_s, app.state.lane),
        ws="websockets-sansio",
        lifespan="on",
        timeout_keep_alive=30,
        timeout_graceful_shutdown=SHUTDOWN_S,
        server_header=False,
    )
    url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
    server = _Server(config, on_ready, lambda: app.state.service.hub.close(), app.state.keys.reload, url)
    sys.setswitchinterval(SWITCH_S)
    # Workers inherit it: their matrices are small and gain nothing from more threads, while the service would wait.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with contextlib.suppress(KeyboardInterrupt), listener:  # raised again once everything is closed in good order
        server.run(sockets=[listener])


def _listen(settings: Settings) -> socket.socket:
    try:
        family, kind, number, _, address = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, number)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ServerError(f"TWIN_HOST {settings.host}, TWIN_PORT {settings.port}: {reason}; choose another") from error
    return listener


class _Server(uvicorn.Server):
    """A server that tells when it is ready."""

    def __init__(
        self,
        config: uvicorn.Config,
        on_ready: Callable[[str], None] | None,
        end_streams: Callable[[], None],
        on_hangup: Callable[[], None],
        url: str,
    ) -> None:
        super().__init__(config)
        self._on_ready, self._end_streams, self._url = on_ready, end_streams, url
        self._on_hangup = on_hangup

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the streams first: they would hold the shutdown up until its deadline."""
        self._end_streams()
        await super().shutdown(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, self._on_hangup)
        await super().startup(sockets)
        gc.collect()
        gc.freeze()  # what is there now stays: looking through it again and again costs milliseconds each time
        if not self.should_exit and self._on_ready is not None:
            self._on_ready(self._url)
