"""What has had its day is forgotten, now and then."""

import asyncio
import contextlib
import logging

from service.problems import Problem
from service.store import aside
from service.store.database import Database

log = logging.getLogger("service")

EVERY_S = 600.0


class Housekeeping:
    """Forgets deleted samples once their deletion can no longer be undone."""

    def __init__(self, database: Database) -> None:
        """Begin at once."""
        self._database = database
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        """Stop."""
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task

    async def _run(self) -> None:
        while True:
            try:
                gone = await self._database.write(aside.expire)
                if gone:
                    log.info("deleted samples are gone for ever", extra={"n": gone})
            except Problem as error:
                log.warning("deleted samples are still there", extra={"reason": error.detail})
            await asyncio.sleep(EVERY_S)
