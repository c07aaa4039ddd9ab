"""Questions that wait at the same time are asked together."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Generic, TypeVar

Q = TypeVar("Q")
A = TypeVar("A")


class Batches(Generic[Q, A]):
    """Hands questions on as they come; those that come while as many batches as may be are under way, as one."""

    def __init__(self, ask: Callable[[list[Q]], Awaitable[Sequence[A | Exception]]], at_once: int, most: int) -> None:
        """Ask with a function that answers a list of questions: ``at_once`` batches at a time, of ``most`` questions each."""
        self._ask, self._at_once, self._most = ask, at_once, most
        self._waiting: list[tuple[Q, asyncio.Future[A]]] = []
        self._under_way: set[asyncio.Task[None]] = set()
        self._takers = 0
        """Of those under way, how many look again for what waits; one that has looked in vain may not have ended yet."""

    async def ask(self, question: Q) -> A:
        """Return the answer to one question, or raise what stands in its place."""
        answer: asyncio.Future[A] = asyncio.get_running_loop().create_future()
        self._waiting.append((question, answer))
        if self._takers < self._at_once:
            self._takers += 1
            task = asyncio.create_task(self._go_on())
            self._under_way.add(task)
            task.add_done_callback(self._under_way.discard)
        return await answer

    async def _go_on(self) -> None:
        try:
            while self._waiting:
                await self._ask_some()
        finally:
            self._takers -= 1

    async def _ask_some(self) -> None:
        batch, self._waiting = self._waiting[: self._most], self._waiting[self._most :]
        wanted = [(question, answer) for question, answer in batch if not answer.done()]
        try:
            found = await self._ask([question for question, _ in wanted])
        except Exception as error:
            found = [error] * len(wanted)
        for (_, answer), one in zip(wanted, found, strict=True):
            if answer.done():  # nobody waits any more
                continue
            if isinstance(one, Exception):
                answer.set_exception(one)
            else:
                answer.set_result(one)
