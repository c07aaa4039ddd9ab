"""A worker: a process that does the jobs which service processes queue, and serves nobody."""

import asyncio
import contextlib
import logging
import signal
from collections.abc import Callable
from functools import partial
from wsgiref.simple_server import WSGIServer

from prometheus_client import start_http_server

from service.monitoring.metrics import Metrics
from service.running.start import running
from service.settings import Settings, SettingsError
from service.store.database import Database
from service.workbench.core import CoreWorkbench
from service.workbench.interface import MakeWorkbench

LOOK_S = 5.0
"""So often a worker looks whether the database answers, for its metrics."""
log = logging.getLogger("service")


def work(
    settings: Settings, on_ready: Callable[[], None] | None = None, workbench: MakeWorkbench | None = None
) -> None:
    """Do jobs until interrupted; those under way wait for another worker then.

    Raises
    ------
    SettingsError, StoreError
        If the database is a file, which one process has for itself, or cannot be used; if the port of the metrics is taken.
    """
    if isinstance(settings.database, str):
        settings = settings.model_copy(update={"assimilate": False, "job_workers": max(settings.job_workers, 1)})
        asyncio.run(_work(settings, on_ready, workbench or partial(CoreWorkbench, settings.effect_files)))
    else:
        raise SettingsError("TWIN_DATABASE_URL: a worker needs a database that processes can share: postgresql://…")


async def _work(settings: Settings, on_ready: Callable[[], None] | None, workbench: MakeWorkbench) -> None:
    end = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, end.set)
    metrics = Metrics()
    told = None if settings.metrics_port is None else _tell(metrics, settings.metrics_host, settings.metrics_port)
    try:
        database = Database(settings.database)
        try:
            async with running(settings, database, metrics, workbench):
                if on_ready is not None:
                    on_ready()
                while not end.is_set():
                    await metrics.look(database)
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(LOOK_S):
                            await end.wait()
        finally:
            database.close()
    finally:
        if told is not None:
            await asyncio.to_thread(told.shutdown)
            told.server_close()


def _tell(metrics: Metrics, host: str, port: int) -> WSGIServer:
    """Serve metrics at http://HOST:PORT/metrics."""
    try:
        server, _ = start_http_server(port, host, metrics.registry)
    except OSError as error:
        reason = error.strerror or str(error)
        raise SettingsError(f"TWIN_METRICS_HOST {host}, TWIN_METRICS_PORT {port}: {reason}; choose another") from error
    log.info("metrics are served", extra={"url": f"http://{host}:{server.server_port}/metrics"})
    return server
