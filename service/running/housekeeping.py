"""What has had its day is removed, in short writes between which everybody else has a turn."""

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable
from functools import partial

from service.errors import Refusal
from service.fleet.ownership import Ownership
from service.store import aside, retention
from service.store.connection import Connection
from service.store.database import Database

log = logging.getLogger("service")

EVERY_S = 600.0
SUCCESSION_S = 1.0
"""A process that does not lead asks so often whether it does now: at its start it has no lease yet."""
PAUSE_S = 0.01
CHORES: tuple[tuple[str, Callable[[Connection], int]], ...] = (
    ("deleted samples that can no longer be restored", aside.expire),
    ("twins that were deleted", retention.sweep_gone),
)


class Housekeeping:
    """Does the chores at the start, now and then, and when it is woken."""

    def __init__(self, database: Database, ownership: Ownership) -> None:
        """Begin at once."""
        self._database, self._ownership = database, ownership
        self._wake = asyncio.Event()
        self._task = asyncio.create_task(self._run())

    def wake(self) -> None:
        """Hear that there is something to do."""
        self._wake.set()

    async def close(self) -> None:
        """Stop."""
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task

    async def _run(self) -> None:
        while True:
            self._wake.clear()
            leads = self._ownership.leads
            for what, chore in (*CHORES, *self._database.engine.chores) if leads else ():
                await self._finish(what, partial(self._database.write, chore))
            if leads:
                await self._finish(
                    "what nobody keeps any more", partial(asyncio.to_thread, self._database.engine.drop_old)
                )
                await self._sweep()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(EVERY_S if leads else SUCCESSION_S):
                    await self._wake.wait()

    async def _sweep(self) -> None:
        """Remove what is older than its twin keeps, one twin after another: only readers look at the whole fleet."""
        try:
            twins = await self._database.read(retention.due)
        except Exception as error:
            _warn("old rows", error)
            return
        for twin in twins:
            await self._finish(
                "what is older than its twin keeps",
                partial(self._database.write_to, twin, retention.sweep_old, twin),
            )

    async def _finish(self, what: str, chore: Callable[[], Awaitable[int]]) -> None:
        """Do a chore until there is nothing left to do, or it cannot be done: the next time may be a better one."""
        removed = 0
        try:
            while done := await chore():
                removed += done
                await asyncio.sleep(PAUSE_S)
        except Exception as error:
            _warn(what, error)
        if removed:
            log.info("removed for ever", extra={"what": what, "rows": removed})


def _warn(what: str, error: Exception) -> None:
    reason = error.detail if isinstance(error, Refusal) else f"{type(error).__name__}: {error}"
    log.warning("housekeeping was interrupted", extra={"chore": what, "reason": reason})
