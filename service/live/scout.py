"""The scout: where the spacecraft is now, found from the newest samples while the archive before them is still assimilated.

What it says is provisional: residuals and anomalies that the assimilation of the whole archive replaces when it comes by.
"""

import logging
from dataclasses import dataclass

import numpy as np

from service.errors import Refusal
from service.fleet.ownership import Guard
from service.live.caution import Caution
from service.live.following import Following, NotFollowed
from service.live.position import Position, is_far, next_count
from service.live.progress import ahead, save
from service.store import samples
from service.store.database import Database
from service.store.models import Active
from service.store.samples import Samples
from service.stream.hub import Hub
from service.twins.registry import Entry
from service.workbench.interface import Telemetry
from twin_core.errors import TwinError

log = logging.getLogger("service.live")

MEMORIES = 3.0
"""The scout begins so many of the network's longest time constants ago: a twentieth of what it began with is left."""
LEAST, MOST = 500, 10_000
"""At least and at most so many samples ago."""


@dataclass(frozen=True)
class Base:
    """How much of the past the scout's state rests on, and how much it takes to forget where it began, in seconds."""

    known_s: float
    needed_s: float

    @property
    def is_short(self) -> bool:
        """Whether slow nodes are known less well than they will be."""
        return self.known_s < self.needed_s


class Scout:
    """Follows the newest samples of a twin with its active model."""

    def __init__(
        self, twin: Entry, database: Database, hub: Hub, following: Following, active: Active, guard: Guard
    ) -> None:
        """Know nothing yet: ``begin`` or ``seed`` it."""
        self._twin, self._database, self._hub, self._following = twin, database, hub, following
        self._active, self._guard = active, guard
        self._caution = Caution()
        self._before: Position | None = None
        self._after_us = 0
        self.position: Position | None = None
        self.base: Base | None = None

    def seed(self, position: Position) -> None:
        """Go on from a state that only lacks samples which came late."""
        self.position = self._before = position
        self._after_us = position.time_us

    async def begin(self) -> None:
        """Go back as far as a forecast needs."""
        n = len(self._twin.channels)
        found = await self._database.read(samples.newest, self._twin.key, n, MOST)
        if found.time_us.size == 0:
            return
        least_us = int(found.time_us[max(found.time_us.size - LEAST, 0)])
        needed_s = await self._needed_s(found)
        start_us = max(int(found.time_us[0]), min(least_us, int(found.time_us[-1] - min(1e6 * needed_s, 2.0**61))))
        self._after_us, self._before = start_us - 1, None
        self.base = Base((int(found.time_us[-1]) - start_us) / 1e6, needed_s)

    async def _needed_s(self, found: Samples) -> float:
        """Return how long the network remembers where it started; infinite where that cannot be told."""
        opening = await self._following.opened(Samples(found.time_us, found.values.copy()))
        values = dict(zip(self._twin.channels, opening.values, strict=True))
        telemetry = Telemetry(self._active.epoch_us, opening.time_us, values)
        try:
            return MEMORIES * await self._following.memory_s(self._active, telemetry)
        except (TwinError, Refusal, ValueError, np.linalg.LinAlgError):
            return float("inf")

    async def advance(self, told_seq: int) -> bool:
        """Follow the next block of what came; return whether there may be more.

        If samples come faster than they can be followed, it begins anew, nearer to the present.
        """
        if await self._database.read(samples.count_after, self._twin.key, self._after_us) > 2 * MOST:
            await self.begin()
        arguments = (self._twin, self._after_us, told_seq, max(self._caution.most, 2), None)
        found, told, revision = await self._database.read(ahead, *arguments)
        count = next_count(found.time_us, self._active.longest_gap_us)
        if count == found.time_us.size > 0 and is_far(found.time_us, self._before, self._active.longest_gap_us):
            count -= 1
        if count == 0:
            return False
        kept = slice(0, min(count, self._caution.most))
        fresh = Samples(found.time_us[kept], found.values[:, kept].copy())
        before = self._before
        if before is None:
            fresh = await self._following.opened(fresh)
        try:
            done = await self._following.filter(self._active, before, fresh)
        except NotFollowed as error:
            if self._caution.failed(fresh.time_us, 0):
                self._after_us = int(fresh.time_us[-1])
            log.info("the newest samples cannot be followed", extra={"twin": self._twin.name, "reason": str(error)})
            return True
        self._caution.succeeded()
        after_us = self._after_us if before is None else before.time_us
        position, step = self._following.step(
            self._active, before, after_us, done, 0, told[: fresh.time_us.size], revision, is_provisional=True
        )
        await self._hub.write(self._twin.key, self._guard(save), self._twin, step)
        self.position = self._before = position
        self._after_us = position.time_us
        return True
