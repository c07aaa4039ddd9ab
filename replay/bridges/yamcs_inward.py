"""One direction of the bridge: telemetry from Yamcs into a twin, as it comes and out of the archive."""

import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from replay.bridges.config import YamcsConfig
from replay.bridges.errors import Away, BridgeError
from replay.bridges.instants import parse_utc_ms, service_ms, to_text
from replay.bridges.twin_side import TwinSide
from replay.bridges.yamcs_gateway import Row, YamcsGateway
from replay.bridges.yamcs_wiring import Wiring, wire
from replay.wording import counted
from service.schemas import TwinDetail

BATCH = 2000
"""Most rows sent to the service in one request."""
SLICE_S = 0.2
"""So long the archive is read before what is live has its turn."""
HELD = 200_000
"""Rows of the subscription that may wait; beyond them the connection begins anew and fetches from the archive."""


@dataclass
class Taken:
    """What a twin has been given."""

    samples: int = 0
    accepted: int = 0
    duplicates: int = 0
    rejected: int = 0
    quarantined: int = 0


class Inward:
    """Feeds a twin through one connection to Yamcs."""

    def __init__(
        self, config: YamcsConfig, gateway: YamcsGateway, side: TwinSide, tally: Taken, tell: Callable[[str], None]
    ) -> None:
        """Feed nothing yet."""
        self._config, self._gateway, self._side, self._tally, self._tell = config, gateway, side, tally, tell
        self._subscription: Any = None
        self._inbox: queue.Queue[Row] = queue.Queue(HELD)
        self._overrun = threading.Event()

    def begin(self, twin: TwinDetail, *, first: bool) -> None:
        """Check names and units, subscribe, and fetch what was missed; BridgeError ``first`` where something fits not."""
        names = [source.name for source in self._config.parameters.values()]
        self._wiring = self._wire(twin, names, first)
        self._subscription = self._gateway.subscribe(list(self._wiring.feeds), self._hear)
        for _ in self.backfill(twin):
            pass  # what is live waits: a twin is given its past in order

    def end(self) -> None:
        """Hear nothing any more."""
        if self._subscription is not None:
            self._subscription.cancel()

    def check(self) -> None:
        """Raise Away where the subscription broke off, or brought more than could be passed on."""
        if self._overrun.is_set():
            raise Away("Yamcs sends more than the service takes; going on from its archive")
        if self._subscription.done():
            raise Away(f"Yamcs at {self._gateway.url}: the subscription broke off")

    def _wire(self, twin: TwinDetail, names: Sequence[str], first: bool) -> Wiring:
        wiring = wire(self._config, twin, self._gateway.declared(names))
        if wiring.faults and first:
            raise BridgeError("; ".join(wiring.faults))
        for fault in wiring.faults:  # the mission database changed meanwhile: what still fits goes on
            self._tell(f"{fault}; it is left out")
        return wiring

    def _hear(self, row: Row) -> None:
        try:
            self._inbox.put_nowait(row)
        except queue.Full:
            self._overrun.set()

    def drain(self, wait_s: float) -> None:
        """Send what arrived, waiting for the first row at most so long."""
        rows: list[Row] = []
        with suppress(queue.Empty):  # the end of what waits
            rows.append(self._inbox.get(timeout=wait_s))
            while len(rows) < BATCH:
                rows.append(self._inbox.get_nowait())
        self._ingest(rows)

    def backfill(self, twin: TwinDetail) -> Iterator[None]:
        """Fetch from Yamcs' archive what the twin may lack, in slices of time: all of it at first, then the recent past."""
        start = self._config.backfill.start
        first_ms = parse_utc_ms(start) if start else None
        if twin.last_time is not None:
            recent_ms = service_ms(twin.last_time) - round(1000 * self._config.backfill.look_back_s)
            first_ms = recent_ms if first_ms is None else max(first_ms, recent_ms)
        if first_ms is None:
            return
        rows: list[Row] = []
        pause_s = time.monotonic() + SLICE_S
        for row in self._gateway.history(list(self._wiring.feeds), first_ms):
            rows.append(row)
            if len(rows) == BATCH:
                self._ingest(rows)
                rows = []
            if time.monotonic() >= pause_s:
                yield
                pause_s = time.monotonic() + SLICE_S
        self._ingest(rows)

    def _ingest(self, rows: Sequence[Row]) -> None:
        """Send rows to the service as columns; one sample per generation time."""
        samples: dict[int, dict[str, float]] = {}
        for row in rows:
            values = self._wiring.values(row)
            if values:
                samples.setdefault(row.time_ms, {}).update(values)
        if not samples:
            return
        times = sorted(samples)
        channels = sorted({channel for values in samples.values() for channel in values})
        columns = {channel: [samples[t].get(channel) for t in times] for channel in channels}
        instants = [to_text(t) for t in times]
        report = self._side.sure(lambda: self._side.client.ingest(self._side.twin, instants, columns))
        self._tally.samples += len(times)
        self._tally.accepted += report.accepted
        self._tally.duplicates += report.duplicates
        self._tally.rejected += len(report.rejected)
        self._tally.quarantined += len(report.quarantined)
        for reason, found in _grouped((item.reason, item.index) for item in report.rejected).items():
            first = instants[found[0]]
            self._tell(f"{counted(len(found), 'sample')} refused by the service, the first at {first}: {reason}")
        if report.quarantined:
            first = instants[report.quarantined[0].index]
            self._tell(f"samples from {first} on lie ahead of the service's clock")


def _grouped(pairs: Iterable[tuple[str, int]]) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for key, value in pairs:
        found.setdefault(key, []).append(value)
    return found
