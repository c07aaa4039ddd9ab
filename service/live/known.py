"""What is known of a twin's present state: by its tracker in this process, or from what that of another one has written down."""

import asyncio
from typing import Protocol

import numpy as np

from service.live.position import Position, is_far
from service.live.progress import BLOCK
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
        """Know nothing before somebody looks."""
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
            await self.look()
            at_us = None if self.position is None else self.position.time_us
            if self.active is None or head.last_us is None or (at_us is not None and at_us >= head.last_us):
                return True
            if self.waits_us == head.last_us:
                return True
            if loop.time() >= until_s:
                return False
            await asyncio.sleep(LOOK_S)

    async def look(self) -> None:
        """Read the state as it is written down now."""
        await self._database.read(self._look)

    def _look(self, connection: Connection) -> None:
        self.active = models.active(connection, self.twin.key)
        if self.active is None:
            self.position, self.waits_us, self.floor_us, self.left, self.catching_up = None, None, None, 0, False
            return
        found = checkpoints.before(connection, self.twin.key, self.active.version)
        self.position = None if found is None else Position.of(found)
        self.floor_us = checkpoints.floor(connection, self.twin.key, self.active.version)
        begun_us = None if self.floor_us is None else self.floor_us - 1
        self.left = samples.count_after(connection, self.twin.key, begun_us if found is None else found.time_us)
        self.catching_up = self.left >= BLOCK or (self.position is None and self.left > 0)
        last_us = twins.get(connection, self.twin.name).last_us
        self.waits_us = last_us if self.left == 1 and last_us is not None and self._is_far(last_us) else None
        self.left = 0 if self.waits_us is not None else self.left

    def _is_far(self, last_us: int) -> bool:
        """Return whether the tracker lets a lone sample wait for company."""
        if self.active is None or self.position is None:
            return False
        return is_far(np.array([last_us], dtype=np.int64), self.position, self.active.longest_gap_us)
