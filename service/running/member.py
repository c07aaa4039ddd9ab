"""A service as a member of a fleet: it follows the twins that it owns, and takes over what other processes change."""

import asyncio
import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from service.fleet.ownership import Leases
from service.store.errors import Missing, TwinGone
from service.store.ownership import Changed
from service.twins.registry import Entry

if TYPE_CHECKING:
    from service.fleet.bus import Bus
    from service.running.service import Service
    from service.settings import Settings
    from service.store.database import Database

log = logging.getLogger("service.fleet")

JOIN_S = 5.0
"""A start waits no longer for the first leases."""


def join(database: "Database", settings: "Settings") -> "tuple[Leases, Bus] | tuple[None, None]":
    """Return leases and bus where other processes may share the database; neither has begun."""
    if not database.is_shared:
        return None, None
    from service.fleet.bus import Bus

    leases = Leases()
    return leases, Bus(settings.database_url, leases, beat=settings.assimilate)


class Member:
    """Applies what the bus hears to the service, one after another."""

    def __init__(self, service: "Service", bus: "Bus", leases: Leases) -> None:
        """Begin to listen."""
        self._service, self._bus, self._leases = service, bus, leases
        self._loop = asyncio.get_running_loop()
        self._known: dict[int, Changed] = {}
        self._entries: dict[int, Entry] = {}
        self._heard: asyncio.Queue[tuple[Sequence[Changed], bool]] = asyncio.Queue()
        self._joined = asyncio.Event()
        self._task = asyncio.create_task(self._run())
        bus.start(self._hear)

    async def joined(self) -> None:
        """Return once the first leases are there, or after a while."""
        try:
            async with asyncio.timeout(JOIN_S):
                await self._joined.wait()
        except TimeoutError:
            log.warning("the fleet cannot be joined yet")

    async def close(self) -> None:
        """Leave."""
        self._task.cancel()
        await asyncio.wait([self._task])
        await asyncio.to_thread(self._bus.close)

    def _hear(self, changed: Sequence[Changed], whole: bool) -> None:
        """Take over from the bus's thread."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._heard.put_nowait, (changed, whole))

    async def _run(self) -> None:
        while True:
            changed, whole = await self._heard.get()
            try:
                for one in changed:
                    await self._apply(one)
                if whole:
                    await self._drop_all_but({one.twin for one in changed})
                    await self._service.follow_own()
                    self._joined.set()
            except Exception:
                log.exception("changes of other processes could not be taken over")

    async def _apply(self, one: Changed) -> None:
        before = self._known.get(one.twin)
        if before == one or one.twin in self._service.leaving:  # who deletes it may wait for its jobs, for long
            return
        service = self._service
        try:
            entry = await service.find(one.name)
            if entry.key != one.twin or entry.revision < one.revision:
                entry = await service.find_now(one.name)
        except (Missing, TwinGone):
            return
        if entry.key != one.twin:  # another one stands in its place by now, which is told of, too
            return
        self._known[one.twin], self._entries[one.twin] = one, entry
        if before is None:  # a request may have let it be followed before this, and before what this tells of
            service.live.archive_changed(entry)
        service.follow(entry)
        if one.seq > service.hub.head(one.twin):
            service.hub.advance(one.twin, one.seq)
        if before is None or before.seq != one.seq:  # a message of our own may be later than samples of others
            service.live.arrived(entry)
        if before is not None and before.archive != one.archive:
            service.live.archive_changed(entry)
        elif before is not None and before.activation != one.activation:
            service.live.model_changed(one.twin)

    async def _drop_all_but(self, there: set[int]) -> None:
        for twin in self._known.keys() - there:
            del self._known[twin]
            await self._service.forget_twin(self._entries.pop(twin))
