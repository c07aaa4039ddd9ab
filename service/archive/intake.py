"""The intake: batches of a twin that arrive while a commit is under way wait for it and share the next one.

What a commit costs beside the disk (statements, hand-overs between threads) is thus paid once for many small requests.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from service.instants import now_us
from service.live.live import Live
from service.monitoring import tracing
from service.monitoring.metrics import Metrics
from service.store import segments
from service.store.admission import admit
from service.store.appending import Receipt
from service.store.batch import MOST_VALUES, Batch
from service.store.connection import Connection
from service.store.merge import ACCEPTED, CONFLICT, DUPLICATE, QUARANTINED
from service.stream.hub import Hub, settle
from service.stream.messages import SampleStretch
from service.twins.registry import Entry

log = logging.getLogger("service")

OUTCOMES = {"accepted": ACCEPTED, "duplicate": DUPLICATE, "rejected": CONFLICT, "quarantined": QUARANTINED}


MOST_SMALL_VALUES = 8192
"""A batch of no more than so many values is small: writing it takes about as long as handing it to another thread."""


Then = Callable[[Any, BaseException | None], None]
"""Who hears the receipt of a batch, or else the error."""


class _Ticket(NamedTuple):
    """A batch that waits to be stored, and where its receipt goes."""

    batch: Batch
    then: Then


class Intake:
    """Stores samples, each twin's in the order of their arrival."""

    def __init__(self, hub: Hub, live: Live, metrics: Metrics, clock_tolerance_s: float) -> None:
        """Tell streams, trackers and metrics what was stored; samples may be ahead of this machine's clock by a tolerance."""
        self._hub, self._live = hub, live
        self._samples = cache(metrics.samples.labels)
        self._tolerance_us = round(clock_tolerance_s * 1e6)
        self._loop = asyncio.get_running_loop()
        self._lines: dict[int, list[_Ticket]] = {}
        """Of each twin with a commit under way or about to begin: what waits for the next one."""
        self._tidied: set[int] = set()
        """Twins whose small segments are being compacted."""

    async def store(self, twin: Entry, batch: Batch) -> Receipt:
        """Return what became of a batch, once it is durably committed."""
        receipt: asyncio.Future[Receipt] = self._loop.create_future()
        with tracing.part("store", {"thermal_twin.twin": twin.name, "thermal_twin.samples": batch.time_us.size}):
            tracing.remember(twin.key)
            self.enter(twin, batch, partial(settle, receipt))
            return await receipt

    def enter(self, twin: Entry, batch: Batch, then: Then) -> None:
        """Store a batch with what else the event loop has at hand, and let ``then`` hear its receipt, or the error."""
        batch = Batch(batch.time_us, batch.values, np.full(batch.time_us.size, now_us()))
        if twin.key not in self._lines:
            self._lines[twin.key] = []
            self._loop.call_soon(self._begin, twin)
        self._lines[twin.key].append(_Ticket(batch, then))

    def _begin(self, twin: Entry) -> None:
        """Hand what waits to the writer as one batch."""
        line = self._lines[twin.key]
        n_first = 1
        if len(line) > 1:
            n_values = accumulate(ticket.batch.values.size for ticket in line)
            n_first = max(1, sum(n <= MOST_VALUES for n in n_values))
        tickets, self._lines[twin.key] = line[:n_first], line[n_first:]
        if tickets:
            batch = _joined([ticket.batch for ticket in tickets])
            submit = self._hub.submit_small if batch.values.size <= MOST_SMALL_VALUES else self._hub.submit_then
            submit(partial(self._done, twin, tickets), twin.key, take_in, twin, batch, self._tolerance_us)
        else:
            del self._lines[twin.key]

    def _done(self, twin: Entry, tickets: list[_Ticket], receipt: Receipt, error: BaseException | None) -> None:
        """Hand out the receipts, and begin anew with what came meanwhile."""
        if error is None:
            self._tell(twin, receipt)
        first = 0
        for ticket in tickets:
            stop = first + ticket.batch.time_us.size
            alone = error is not None or len(tickets) == 1
            ticket.then(receipt if alone else replace(receipt, status=receipt.status[first:stop]), error)
            first = stop
        self._loop.call_soon(self._begin, twin)

    def _tell(self, twin: Entry, receipt: Receipt) -> None:
        counts = receipt.counts
        for outcome, status in OUTCOMES.items():
            if counts[status]:
                self._samples(twin.name, outcome).inc(counts[status])
        if receipt.moved:
            log.warning(
                "samples ahead of the present go into quarantine", extra={"twin": twin.name, "n": receipt.moved}
            )
            self._live.archive_changed(twin)
        if receipt.is_crowded and twin.key not in self._tidied:
            self._tidied.add(twin.key)
            self._hub.submit_then(partial(self._is_tidy, twin), twin.key, tidy, twin)
        if counts[ACCEPTED]:
            self._live.arrived(twin)

    def _is_tidy(self, twin: Entry, _: None, error: BaseException | None) -> None:
        """Hear that the small segments of a twin are compacted, or that this failed: then the next batch asks for it again."""
        self._tidied.discard(twin.key)
        if error is not None:
            log.warning("small segments were not compacted", extra={"twin": twin.name, "reason": type(error).__name__})


def tidy(connection: Connection, twin: Entry) -> tuple[None, Sequence[SampleStretch]]:
    """Compact the small segments of a twin."""
    segments.compact(connection, {twin.key: len(twin.channels)})
    return None, ()


def _joined(batches: list[Batch]) -> Batch:
    """Return batches as one, in their order."""
    if len(batches) == 1:
        return batches[0]
    return segments.joined(batches, max(batch.values.shape[0] for batch in batches))


def take_in(
    connection: Connection, twin: Entry, batch: Batch, tolerance_us: int
) -> tuple[Receipt, Sequence[SampleStretch]]:
    """Store a batch; return what became of it, and what the stream hears. A tolerance of 0 takes in what lies ahead, too.

    Small segments are not compacted: the receipt says when that is due.
    """
    receipt = admit(connection, twin.key, batch, tolerance_us, compacts=False)
    n_stored = receipt.counts[ACCEPTED]
    if n_stored == 0:
        return receipt, ()
    time_us, values = batch.time_us, batch.values
    if n_stored < time_us.size:
        time_us, values = time_us[receipt.stored], values[:, receipt.stored]
    seqs = np.arange(receipt.first_seq, receipt.first_seq + n_stored)
    return receipt, (SampleStretch(twin.channels, seqs, time_us, values),)
