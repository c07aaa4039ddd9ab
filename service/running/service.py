"""The running service: what its parts are, and how twins come, change and go."""

import asyncio
import contextlib
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
    _leaving: set[int] = field(default_factory=set)

    def add_twin(self, twin: Twin, spec: TwinSpec | None = None) -> Entry:
        """Let a stored twin take part in everything; its specification need not be checked again where it just was."""
        entry = self.registry.add(twin)
        if spec is not None:
            entry.know(spec)
        self.hub.open(entry.key, twin.seq)
        if self.settings.assimilate and self.ownership.owns(entry.key):
            self.live.add(entry)
        self.live.arrived(entry)  # what the archive holds and nobody has looked at
        return entry

    async def find(self, name: str) -> Entry:
        """Return a twin; one that another process registered a moment ago is looked for in the store."""
        try:
            return self.registry.get(name)
        except Missing:
            if not self.database.is_shared:
                raise
        async with self._coming_and_going:
            return self.add_twin(await self.database.read(twins.get, name))

    async def find_key(self, key: int) -> Entry | None:
        """Return a twin by its number, None if it is gone, or going: who deletes it waits for its jobs."""
        if key in self._leaving:
            return None
        known = next((entry for entry in self.registry if entry.key == key), None)
        if known is None and self.database.is_shared:
            found = await self.database.read(ownership.changes, [key])
            with contextlib.suppress(Missing):
                known = await self.find(found[0].name) if found else None
        return known

    async def forget_twin(self, twin: Entry) -> None:
        """Let a twin that another process deleted take part in nothing any more."""
        async with self._coming_and_going:
            self.registry.remove(twin.name)
            await self.live.remove(twin)
            self.hub.close(twin.key)

    async def renew_twin(self, twin: Entry) -> None:
        """Take over a specification that another process changed; streams end and resume."""
        async with self._coming_and_going:
            made = await self.database.read(twins.get, twin.name)
            await self.live.remove(twin)
            self.hub.close(twin.key)
            self.registry.replace(made)
            self.add_twin(made)

    async def register(self, spec: TwinSpec, data: dict[str, Any]) -> tuple[Twin, bool]:
        """Return the twin, and whether it is new; never between the steps of a deletion."""
        async with self._coming_and_going:
            twin, is_new = await self.database.write(twins.register, spec.twin, data)
            self.add_twin(twin, spec if is_new else None)
            return twin, is_new

    async def revise(self, twin: Entry, spec: TwinSpec, data: dict[str, Any]) -> tuple[Twin, bool]:
        """Give a twin another specification; return it, and whether anything changed. Streams end and resume."""
        async with self._coming_and_going:
            if self.registry.get(twin.name) is not twin:
                raise TwinGone(f"twin {twin.key} is gone")
            made, is_new = await self.database.write_to(twin.key, twins.revise, twin.name, data)
            if is_new:
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
            self._leaving.add(twin.key)
            try:
                await self.jobs.cancel_twin(twin)
                await self.live.remove(twin)
                await self.database.write_to(twin.key, twins.delete, twin.name)
            finally:
                self._leaving.discard(twin.key)
            self.hub.close(twin.key)
            self.housekeeping.wake()
