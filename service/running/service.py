"""The running service: what its parts are, and how twins come, change and go."""

import asyncio
import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from service.archive.intake import Intake
from service.fleet.ownership import Ownership
from service.jobs import outcome
from service.jobs.runner import Jobs
from service.live.live import Live
from service.monitoring.metrics import Metrics
from service.running.housekeeping import Housekeeping
from service.settings import Settings
from service.store import ownership, retention, twins
from service.store.database import Database
from service.store.errors import Missing, TwinGone
from service.store.twins import Twin
from service.stream.hub import Hub
from service.twins.registry import Entry, Registry
from twin_core.network.spec import TwinSpec


@dataclass
class Service:
    """Everything that lives as long as the application."""

    settings: Settings
    database: Database
    registry: Registry
    metrics: Metrics
    hub: Hub
    live: Live
    intake: Intake
    jobs: Jobs
    housekeeping: Housekeeping
    ownership: Ownership
    _coming_and_going: asyncio.Lock = field(default_factory=asyncio.Lock)
    leaving: set[int] = field(default_factory=set)
    """Numbers of twins that this process is about to delete."""
    _in_change: set[int] = field(default_factory=set)

    def add_twin(self, twin: Twin, spec: TwinSpec | None = None) -> Entry:
        """Let a stored twin take part in everything; its specification need not be checked again where it just was."""
        entry = self.registry.add(twin)
        if spec is not None:
            entry.know(spec)
        self.hub.open(entry.key, twin.seq)
        if self.settings.assimilate:
            self.live.add(entry)
        self.live.arrived(entry)  # what the archive holds and nobody has looked at
        return entry

    async def find(self, name: str) -> Entry:
        """Return a twin as this process knows it; one that another process registered is looked for in the store."""
        try:
            return self.registry.get(name)
        except Missing:
            return await self.find_now(name)

    async def find_now(self, name: str) -> Entry:
        """Return a twin as it is now: another process may have changed it, or put another one in its place, a moment ago."""
        if not self.database.is_shared:
            return self.registry.get(name)
        known = self.registry.find(name)
        if known is not None and (known.key, known.revision) == await self.database.read(twins.mark, name):
            return known
        async with self._coming_and_going:  # whatever this process itself changes is done then
            return await self._bring_up(await self.database.read(twins.get, name))

    async def _bring_up(self, twin: Twin, spec: TwinSpec | None = None) -> Entry:
        """Take over what the store holds under a name; streams of what stood there before end."""
        known = self.registry.find(twin.name)
        if known is not None and (known.key, known.revision) != (twin.key, twin.revision):
            with self._changing(known):
                await self.live.remove(known)
                self.hub.close(known.key)
                self.registry.replace(twin)
        return self.add_twin(twin, spec)

    @contextlib.contextmanager
    def _changing(self, twin: Entry) -> Iterator[None]:
        """Let nobody begin to follow a twin meanwhile."""
        self._in_change.add(twin.key)
        try:
            yield
        finally:
            self._in_change.discard(twin.key)

    async def follow_own(self) -> None:
        """Follow the twins that this process owns now, and let go of those that it does not."""
        for twin in self.registry:
            if twin.key in self._in_change:
                continue
            if self.live.is_outlived(twin):
                await self.live.let_go(twin)
            self.follow(twin)

    def follow(self, twin: Entry) -> None:
        """Begin to follow a twin, if this process owns it and does not yet."""
        is_there = self.registry.find(twin.name) is twin and twin.key not in self._in_change
        if self.settings.assimilate and is_there and self.live.add(twin):
            self.live.arrived(twin)

    async def find_key(self, key: int) -> Entry | None:
        """Return a twin by its number, None if it is gone, or going: who deletes it waits for its jobs."""
        if key in self.leaving:
            return None
        if not self.database.is_shared:
            return next((entry for entry in self.registry if entry.key == key), None)
        found = await self.database.read(ownership.changes, [key])
        with contextlib.suppress(Missing):
            known = await self.find_now(found[0].name) if found else None
            return known if known is not None and known.key == key else None
        return None

    async def forget_twin(self, twin: Entry) -> None:
        """Let a twin that another process deleted take part in nothing any more."""
        async with self._coming_and_going:
            known = self.registry.find(twin.name)
            if known is not None and known.key == twin.key:  # or else another one stands in its place by now
                self.registry.remove(twin.name)
            await self.live.remove(twin)
            self.hub.close(twin.key)

    async def register(self, spec: TwinSpec, data: dict[str, Any]) -> tuple[Twin, bool]:
        """Return the twin, and whether it is new; never between the steps of a deletion."""
        async with self._coming_and_going:
            twin, is_new = await self.database.write(twins.register, spec.twin, data)
            await self._bring_up(twin, spec if is_new else None)
            return twin, is_new

    async def revise(self, twin: Entry, spec: TwinSpec, data: dict[str, Any]) -> tuple[Twin, bool]:
        """Give a twin another specification; return it, and whether anything changed. Streams end and resume."""
        async with self._coming_and_going:
            if self.registry.get(twin.name) is not twin:
                raise TwinGone(f"twin {twin.key} is gone")
            made, is_new = await self.database.write_to(twin.key, twins.revise, twin.name, data)
            if is_new:
                with self._changing(twin):
                    await self.live.remove(twin)
                    self.hub.close(twin.key)
                    entry = self.registry.replace(made)
                    entry.know(spec)
                    left = int(entry.sensors != twin.sensors)
                    while left:
                        left = await self.database.write_to(twin.key, retention.forget_derived, twin.key)
                self.add_twin(made)
                news = [("twin", {"revision": made.revision})]
                await self.hub.write(twin.key, outcome.tell, twin.key, news)
            return made, is_new

    async def remove_twin(self, twin: Entry) -> None:
        """Stop whatever concerns a twin, then delete it; TwinGone if somebody else just did."""
        async with self._coming_and_going:
            if self.registry.get(twin.name) is not twin:
                raise TwinGone(f"twin {twin.key} is gone")
            self.registry.remove(twin.name)
            self.leaving.add(twin.key)
            try:
                await self.jobs.cancel_twin(twin)
                await self.live.remove(twin)
                await self.database.write_to(twin.key, twins.delete, twin.name)
            finally:
                self.leaving.discard(twin.key)
            self.hub.close(twin.key)
            self.housekeeping.wake()
