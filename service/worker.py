"""A worker: a process that does the jobs which service processes queue, and serves nobody."""

import asyncio
import signal
from collections.abc import Callable
from functools import partial

from service.monitoring.metrics import Metrics
from service.running.start import running
from service.settings import Settings, SettingsError
from service.store.database import Database
from service.workbench.core import CoreWorkbench
from service.workbench.interface import MakeWorkbench


def work(
    settings: Settings, on_ready: Callable[[], None] | None = None, workbench: MakeWorkbench | None = None
) -> None:
    """Do jobs until interrupted; those under way wait for another worker then.

    Raises
    ------
    SettingsError, StoreError
        If the database is a file, which one process has for itself, or cannot be used.
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
    database = Database(settings.database)
    try:
        async with running(settings, database, Metrics(), workbench):
            if on_ready is not None:
                on_ready()
            await end.wait()
    finally:
        database.close()
