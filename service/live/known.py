"""What is known of a twin's present state: by its tracker in this process, or from what that of another one has written down."""

import asyncio
from typing import Protocol

from service.live.position import Position
from service.live.scout import Base
from service.store import checkpoints, models, samples, twins
from service.store.connection import Connection
from service.store.database import Database
from service.store.models import Active
from service.twins.registry import Entry

PATIENCE_S = 2.0
"""A state that another process works on is waited for no longer: what cannot be assimilated never comes."""
LOOK_S = 0.1


class Known(Protocol):
    """The active model, where its assimilation stands, and what is to be said of that."""

    twin: Entry
    active: Active | None
    trouble: str | None
    waits_us: int | None
    floor_us: int | None
    left: int
    catching_up: bool

    @property
    def position(self) -> Position | None:
        """The latest known state."""

    @property
    def base(self) -> Base | None:
        """How much of the past it rests on; None where that is the whole archive."""

    async def settled(self, timeout_s: float) -> bool:
        """Return whether everything stored so far is assimilated, after waiting for it a while."""


class Stored:
    """The state that another process has written down; each request reads it anew."""

    def __init__(self, twin: Entry, database: Database) -> None:
        """Know nothing before ``settled`` was asked."""
        self.twin, self._database = twin, database
        self.active: Active | None = None
        self.position: Position | None = None
        self.base: Base | None = None
        self.trouble: str | None = None
        self.waits_us: int | None = None
        self.floor_us: int | None = None
        self.left = 0
        self.catching_up = False

    async def settled(self, timeout_s: float) -> bool:
        """Read the state until it has taken in the samples that were stored when this was asked."""
        head = await self._database.read(twins.get, self.twin.name)
        loop = asyncio.get_running_loop()
        until_s = loop.time() + min(timeout_s, PATIENCE_S)
        while True:
            await self._database.read(self._look)
            at_us = None if self.position is None else self.position.time_us
            if self.active is None or head.last_us is None or (at_us is not None and at_us >= head.last_us):
                return True
            if loop.time() >= until_s:
                return False
            await asyncio.sleep(LOOK_S)

    def _look(self, connection: Connection) -> None:
        self.active = models.active(connection, self.twin.key)
        if self.active is None:
            return
        found = checkpoints.before(connection, self.twin.key, self.active.version)
        self.position = None if found is None else Position.of(found)
        self.floor_us = checkpoints.floor(connection, self.twin.key, self.active.version)
        self.left = samples.count_after(connection, self.twin.key, None if found is None else found.time_us)
