"""Live streams: every reader walks along the twin's numbered messages at its own pace.

Nothing is queued per reader. A reader is a position in the stream; what it wants next comes from the recent past in
memory or else from the store, and a reader that lags too far is told so and moved ahead. Writers never wait.
"""

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from functools import partial
from typing import Any, Concatenate, ParamSpec, TypeVar

from service.monitoring.metrics import Metrics
from service.store.database import Database
from service.stream import past
from service.stream.messages import Json, Stretch, dropped
from service.twins.registry import Entry

P = ParamSpec("P")
T = TypeVar("T")
Made = tuple[T, Sequence[Stretch]]
"""What a write returns that makes messages: its result and those messages."""
Then = Callable[[T, BaseException | None], None]
"""Who hears the result of a write, or the error that it ended with."""

IN_MEMORY = 1000
"""Messages of each twin that are kept in memory; readers that lag further behind are served from the store."""
AT_ONCE = 256
"""Most messages handed to a reader in one piece."""
AT_ONCE_STORED = 4096
"""The same where the piece comes from the store, which is asked seldom rather than often."""
IDLE_S = 15.0
"""An idle reader gets an empty piece this often, so that dead connections are noticed."""


class Topic:
    """The stream of one twin."""

    def __init__(self, head: int) -> None:
        """Start after the last number that was given out."""
        self.head = head
        self.oldest = head
        self.recent: deque[Stretch] = deque()
        self.wakers: set[asyncio.Event] = set()
        self.closed = False

    def push(self, stretch: Stretch, most: int) -> None:
        """Take in new messages and forget what lies more than ``most`` numbers back."""
        if int(stretch.seqs[0]) > self.head + 1:  # another process made messages before: only the store has them
            self.recent.clear()
            self.oldest = int(stretch.seqs[0]) - 1
        self.recent.append(stretch)
        self.head = max(self.head, int(stretch.seqs[-1]))
        while self.recent and self.head - int(self.recent[0].seqs[-1]) > most:
            self.oldest = int(self.recent.popleft().seqs[-1])
        self.wake()

    def advance(self, head: int) -> None:
        """Hear that another process made messages up to a number; readers get them from the store."""
        if head > self.head:
            self.head = self.oldest = head
            self.recent.clear()
            self.wake()

    def wake(self) -> None:
        """Let every reader look again."""
        for waker in self.wakers:
            waker.set()

    def since(self, after_seq: int, count: int) -> list[Json]:
        """Return the first messages after a number, from memory."""
        messages: list[Json] = []
        for stretch in self.recent:
            if int(stretch.seqs[-1]) > after_seq:
                messages.extend(stretch.messages(after_seq, count - len(messages)))
                if len(messages) == count:
                    break
        return messages


class Hub:
    """The streams of all twins."""

    def __init__(
        self, database: Database, metrics: Metrics, buffer: int, hint: Callable[[int], None] | None = None
    ) -> None:
        """Readers may lag ``buffer`` messages behind; ``hint`` hears of each twin to which something was written."""
        self._database, self._metrics, self._buffer, self._hint = database, metrics, buffer, hint
        self._loop, self._thread = asyncio.get_running_loop(), threading.get_ident()
        self._topics: dict[int, Topic] = {}
        self._outcomes: deque[tuple[int, Then[Any], Made[Any], BaseException | None]] = deque()

    def open(self, twin: int, head: int) -> None:
        """Start the stream of a twin."""
        self._topics.setdefault(twin, Topic(head))

    def close(self, twin: int | None = None) -> None:
        """End the streams of one twin, or all."""
        for key in [twin] if twin is not None else list(self._topics):
            topic = self._topics.pop(key, None)
            if topic is not None:
                topic.closed = True
                topic.wake()

    def head(self, twin: int) -> int:
        """Return the last number of a twin's stream that was heard of."""
        topic = self._topics.get(twin)
        return 0 if topic is None else topic.head

    def advance(self, twin: int, head: int) -> None:
        """Hear that another process made messages of a twin."""
        topic = self._topics.get(twin)
        if topic is not None:
            topic.advance(head)

    def publish(self, twin: int, stretches: Sequence[Stretch]) -> None:
        """Add committed messages; in the event loop, in the order of the commits."""
        topic = self._topics.get(twin)
        for stretch in stretches:
            if topic is not None and stretch.seqs.size:
                topic.push(stretch, IN_MEMORY)

    def submit(
        self,
        twin: int,
        operation: Callable[Concatenate[Any, P], Made[T]],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> None:
        """Queue a write that makes messages; they are published right after its commit. From any thread."""
        self.submit_then(_ignore, twin, operation, *args, **kwargs)

    def submit_then(
        self,
        then: Then[T],
        twin: int,
        operation: Callable[Concatenate[Any, P], Made[T]],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> None:
        """The same, and let somebody hear in the event loop what came of it."""
        self._database.submit_to(twin, partial(self._after_commit, twin, then), operation, *args, **kwargs)

    def submit_small(
        self,
        then: Then[T],
        twin: int,
        operation: Callable[Concatenate[Any, P], Made[T]],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> None:
        """The same for what writes little, from the event loop: see ``Database.submit_small``."""
        self._database.submit_small(twin, partial(self._after_commit, twin, then), operation, *args, **kwargs)
        self._take_outcomes()

    def _after_commit(self, twin: int, then: Then[Any], made: Made[Any], error: BaseException | None) -> None:
        """Hand an outcome to the event loop; the writer calls this in the order of the commits.

        Waking the loop costs as much as a small write, so it is woken once for all that is handed over meanwhile.
        """
        if self._hint is not None and error is None:
            self._hint(twin)
        self._outcomes.append((twin, then, made, error))
        if len(self._outcomes) == 1 and threading.get_ident() != self._thread and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._take_outcomes)

    def _take_outcomes(self) -> None:
        """Publish what was committed, then let those who wait go on; in the event loop."""
        while self._outcomes:
            twin, then, made, error = self._outcomes.popleft()
            if error is not None:
                then(None, error)
                continue
            result, stretches = made
            self.publish(twin, stretches)
            then(result, None)

    async def write(
        self,
        twin: int,
        operation: Callable[Concatenate[Any, P], Made[T]],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Return the result of a write that makes messages, once it is committed."""
        waiter: asyncio.Future[T] = self._loop.create_future()
        self.submit_then(partial(settle, waiter), twin, operation, *args, **kwargs)
        return await waiter

    async def follow(self, twin: Entry, after_seq: int | None) -> AsyncIterator[list[Json]]:
        """Yield messages in pieces, from a number on or from now on, until the twin or the service goes."""
        topic = self._topics.get(twin.key)
        if topic is None:  # deleted before its reader began
            return
        position = topic.head if after_seq is None else min(after_seq, topic.head)
        waker = asyncio.Event()
        topic.wakers.add(waker)
        self._metrics.readers.inc()
        try:
            while not topic.closed:
                waker.clear()
                if position < topic.head:
                    piece, position = await self._next(twin, topic, position)
                    yield piece
                elif not await _wait(waker):
                    yield []
        finally:
            topic.wakers.discard(waker)
            self._metrics.readers.dec()

    async def _next(self, twin: Entry, topic: Topic, position: int) -> tuple[list[Json], int]:
        """Return the next piece for a reader and its new position."""
        if topic.head - position > self._buffer:
            return self._skip(position, topic.head - self._buffer)
        if position >= topic.oldest:
            messages = topic.since(position, AT_ONCE)
        else:
            names = (twin.channels, twin.sensors)
            messages = await self._database.read(past.since_seq, twin.key, *names, position, AT_ONCE_STORED)
        if not messages:
            return self._skip(position, topic.head)
        first, last = int(messages[0]["seq"]), int(messages[-1]["seq"])
        if last - position == len(messages):
            return messages, last
        if first > position + 1:
            return self._skip(position, first - 1)
        whole = next(i for i, message in enumerate(messages) if message["seq"] != position + 1 + i)
        return messages[:whole], position + whole

    def _skip(self, position: int, last: int) -> tuple[list[Json], int]:
        """Tell a reader that everything up to ``last`` is lost to it."""
        self._metrics.dropped.inc(last - position)
        return [dropped(position + 1, last)], last


def settle(waiter: "asyncio.Future[T]", result: T, error: BaseException | None) -> None:
    """Let a waiter go on, unless it has gone."""
    if waiter.done():
        return
    if error is not None:
        waiter.set_exception(error)
    else:
        waiter.set_result(result)


def _ignore(_: Any, error: BaseException | None) -> None:
    """Want to hear nothing."""


async def _wait(waker: asyncio.Event) -> bool:
    try:
        async with asyncio.timeout(IDLE_S):
            await waker.wait()
    except TimeoutError:
        return False
    return True
