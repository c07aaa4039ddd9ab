"""The engine: standing worker processes for assimilation and forecasts, replaced when one dies."""

import asyncio
import logging
import multiprocessing
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import ParamSpec, TypeVar

from service.errors import Refusal
from service.jobs.executor import prepare_worker
from service.live.batches import Batches
from service.memory import keep_freed
from service.workbench.interface import (
    Filtered,
    Forecasted,
    ForecastTask,
    Json,
    MakeWorkbench,
    Masks,
    Outcome,
    Stretch,
    Telemetry,
)
from service.workbench.watching import watched

P = ParamSpec("P")
T = TypeVar("T")

WORKERS = 2
TOGETHER = 256
"""Most twins that a worker process filters at once: some tens of milliseconds."""
SHORT = 64
"""Stretches of more samples go by themselves: nobody shall wait for a twin that catches up."""
KEPT_BYTES = 32 * 2**20
"""So much freed memory a worker process keeps at most: a forecast of a hundred thousand numbers takes less."""
log = logging.getLogger("service.live")


class WorkerDied(Refusal):
    """A worker process dies over this question, even where it has one to itself."""


class Engine:
    """Runs quick questions to a workbench outside of the server's process."""

    def __init__(self, workbench: MakeWorkbench) -> None:
        """Start nothing yet: the first question starts the first process."""
        self._workbench = workbench
        self._pool: ProcessPoolExecutor | None = None
        self._filters = Batches(self._assimilate, WORKERS, TOGETHER)

    async def assimilate(self, stretch: Stretch) -> Filtered:
        """Filter a stretch of telemetry and look for anomalies in it; short ones that wait at the same time go together."""
        if stretch.telemetry.time_us.size <= SHORT:
            return await self._filters.ask(stretch)
        (found,) = await self._assimilate([stretch])
        if isinstance(found, Exception):
            raise found
        return found

    async def memory_s(self, document: str, telemetry: Telemetry) -> float:
        """Return the longest time constant of a model."""
        return await self._ask(_memory_s, self._workbench, document, telemetry)

    async def score(self, document: str, telemetry: Telemetry) -> float | None:
        """Return the open-loop error of a model."""
        return await self._ask(_score, self._workbench, document, telemetry)

    async def screen(self, units: Mapping[str, str | None], inputs: Collection[str], telemetry: Telemetry) -> Masks:
        """Return which samples are no readings."""
        return await self._ask(_screen, self._workbench, dict(units), tuple(inputs), telemetry)

    async def forecast(self, document: str, task: ForecastTask) -> Forecasted:
        """Look ahead."""
        return await self._ask(_forecast, self._workbench, document, task)

    async def flows(self, document: str, telemetry: Telemetry, state: Json) -> Json:
        """Return the heat flows of a moment."""
        return await self._ask(_flows, self._workbench, document, telemetry, state)

    async def inspect(self, document: Json) -> Outcome:
        """Check a model that was made elsewhere."""
        return await self._ask(_inspect, self._workbench, document)

    async def _assimilate(self, stretches: list[Stretch]) -> Sequence[Filtered | Exception]:
        try:
            return await self._ask(_assimilate, self._workbench, stretches)
        except WorkerDied as error:  # over one of them, which shows where each goes by itself
            return [error] if len(stretches) == 1 else [(await self._assimilate([one]))[0] for one in stretches]

    async def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            await asyncio.to_thread(self._pool.shutdown, True, cancel_futures=True)

    async def _ask(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        pool = self._pool = self._pool or _start(WORKERS)
        try:
            return await asyncio.wrap_future(pool.submit(function, *args, **kwargs))
        except BrokenProcessPool:
            log.warning("a worker process died; another one takes over")
            if self._pool is pool:
                self._pool = None
        alone = _start(1)  # whether it was this question or a neighbour's that the process died of
        try:
            return await asyncio.wrap_future(alone.submit(function, *args, **kwargs))
        except BrokenProcessPool:
            raise WorkerDied("the worker process died twice over this request; try again or recalibrate") from None
        finally:
            alone.shutdown(wait=False)


def _start(workers: int) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_prepare)


def _prepare() -> None:
    """Make a standing worker keep some freed memory: to get megabytes page by page is a sixth of a forecast's time."""
    prepare_worker()
    keep_freed(KEPT_BYTES // 2, KEPT_BYTES)


def _assimilate(workbench: MakeWorkbench, stretches: Sequence[Stretch]) -> Sequence[Filtered | Exception]:
    found = workbench().assimilate(stretches)
    return [
        watched(stretch, one) if isinstance(one, Filtered) else one
        for stretch, one in zip(stretches, found, strict=True)
    ]


def _memory_s(workbench: MakeWorkbench, document: str, telemetry: Telemetry) -> float:
    return workbench().memory_s(document, telemetry)


def _score(workbench: MakeWorkbench, document: str, telemetry: Telemetry) -> float | None:
    return workbench().score(document, telemetry)


def _screen(
    workbench: MakeWorkbench, units: Mapping[str, str | None], inputs: Collection[str], telemetry: Telemetry
) -> Masks:
    return workbench().screen(units, inputs, telemetry)


def _forecast(workbench: MakeWorkbench, document: str, task: ForecastTask) -> Forecasted:
    return workbench().forecast(document, task)


def _flows(workbench: MakeWorkbench, document: str, telemetry: Telemetry, state: Json) -> Json:
    return workbench().flows(document, telemetry, state)


def _inspect(workbench: MakeWorkbench, document: Json) -> Outcome:
    return workbench().inspect(document)
