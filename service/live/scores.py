"""Model errors that can be compared: every version rolled out over the same recent telemetry."""

import asyncio
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import orjson

from service.errors import Refusal
from service.instants import format_instant
from service.live.engine import Engine
from service.store import models, samples, twins
from service.store.database import Database
from service.twins.registry import Entry
from service.workbench.interface import Json, Telemetry

log = logging.getLogger("service.live")

MOST = 2000
"""Samples over which versions are compared: the newest of the archive."""
LEAST = 40
PATIENCE_S = 5.0
"""How long a list of models waits for errors; what takes longer is there next time."""


@dataclass
class _Comparison:
    """The errors of some versions over one stretch of telemetry, found when the archive held so many samples."""

    held: int
    revision: int
    start_us: int
    stop_us: int
    samples: int
    rmse_K: dict[int, float | None]

    def wire(self, version: int) -> Json | None:
        """Return the error of a version as clients see it; None if there is none."""
        rmse_K = self.rmse_K.get(version)
        if rmse_K is None:
            return None
        span = {"start": format_instant(self.start_us), "stop": format_instant(self.stop_us)}
        return {"rmse_K": rmse_K, **span, "samples": self.samples}


class Scores:
    """The comparisons of all twins, each made when somebody asks, and anew when there is much new telemetry."""

    def __init__(self, database: Database, engine: Engine) -> None:
        """Start without any."""
        self._database, self._engine = database, engine
        self._made: dict[int, _Comparison] = {}
        self._under_way: dict[int, asyncio.Task[None]] = {}

    async def of(self, twin: Entry, versions: Sequence[int]) -> dict[int, Json | None]:
        """Return the errors of some versions, all over the same telemetry; None where one is not known."""
        head = await self._database.read(twins.get, twin.name)
        revision = await self._database.read(samples.revision, twin.key)
        made = self._made.get(twin.key)
        is_old = made is None or made.revision != revision or head.samples > made.held + MOST
        if head.samples >= LEAST and (made is None or is_old or not made.rmse_K.keys() >= set(versions)):
            if twin.key not in self._under_way:
                self._under_way[twin.key] = asyncio.create_task(self._compare(twin, versions, head.samples, revision))
            await asyncio.wait([self._under_way[twin.key]], timeout=PATIENCE_S)
        made = self._made.get(twin.key)
        return {version: None if made is None else made.wire(version) for version in versions}

    def forget(self, twin: Entry) -> None:
        """Forget a twin."""
        self._made.pop(twin.key, None)

    async def close(self) -> None:
        """Stop."""
        tasks = list(self._under_way.values())
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def _compare(self, twin: Entry, versions: Sequence[int], held: int, revision: int) -> None:
        try:
            found = await self._database.read(samples.newest, twin.key, len(twin.channels), MOST)
            values = {name: found.values[row] for row, name in enumerate(twin.channels)}
            present = {name: column for name, column in values.items() if np.isfinite(column).any()}
            rmse_K: dict[int, float | None] = {}
            for version in versions:
                document = await self._database.read(models.document, twin.key, version)
                row = await self._database.read(models.get, twin.key, version)
                epoch_us = int(orjson.loads(row.summary)["epoch_us"])
                telemetry = Telemetry(epoch_us, found.time_us, present)
                rmse_K[version] = await self._error_K(twin, version, orjson.dumps(document).decode(), telemetry)
            ends = int(found.time_us[0]), int(found.time_us[-1])
            self._made[twin.key] = _Comparison(held, revision, *ends, int(found.time_us.size), rmse_K)
        except (LookupError, Refusal) as error:
            log.info("models could not be compared", extra={"twin": twin.name, "reason": str(error)})
        finally:
            del self._under_way[twin.key]

    async def _error_K(self, twin: Entry, version: int, document: str, telemetry: Telemetry) -> float | None:
        """Return the error of one version; None if it cannot be rolled out."""
        try:
            return await self._engine.score(document, telemetry)
        except Exception as error:  # whatever a model does wrong, the others have errors
            extra = {"twin": twin.name, "version": version, "reason": str(error)}
            log.info("a model has no error over recent telemetry", extra=extra)
            return None
