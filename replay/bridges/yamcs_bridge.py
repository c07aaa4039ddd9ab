"""The bridge itself: telemetry from Yamcs into a twin, forecasts, residuals and events of the twin into Yamcs.

It keeps nothing on disk. What the service holds and what Yamcs holds are asked for whenever a connection begins, so a
restart on either side, or of the bridge, loses nothing and repeats nothing: samples that come again are recognised by the
service, events by Yamcs, and of published rows those are left out whose generation time is there already.
"""

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass

from replay.bridges.config import YamcsConfig
from replay.bridges.errors import Away, ServiceAway
from replay.bridges.twin_side import TwinSide
from replay.bridges.yamcs_gateway import YamcsGateway
from replay.bridges.yamcs_inward import Inward, Taken
from replay.bridges.yamcs_outward import Given, Outward
from service.client import TwinClient

PAUSE_S, LONGEST_PAUSE_S = 0.5, 15.0
"""Between two attempts to connect: doubles from the first to the last."""
SHARE = 0.1
"""At most this share of the time goes into reading the archive again."""
_NUMBER = re.compile(r"\d+(\.\d+)?")
_END = object()


@dataclass
class Tally(Given, Taken):
    """What a bridge has done so far."""

    connections: int = 0


class YamcsBridge:
    """Keeps one twin and one Yamcs instance in step, until asked to stop."""

    def __init__(
        self,
        config: YamcsConfig,
        connect: Callable[[], YamcsGateway],
        client: TwinClient,
        service_url: str,
        tell: Callable[[str], None],
        poll_s: float = 1.0,
    ) -> None:
        """Speak to Yamcs through what ``connect`` returns; ``tell`` hears each remark once."""
        self._config, self._connect, self._side = config, connect, TwinSide(client, config.twin)
        self._reports = f"{(config.report_url or service_url).rstrip('/')}/v1/twins/{config.twin}/diagnoses"
        self._tell_it, self._poll_s = tell, poll_s
        self._told: set[str] = set()
        self.tally = Tally()
        self._stop = threading.Event()

    def stop(self) -> None:
        """Let ``run`` end soon."""
        self._stop.set()

    def tell(self, sentence: str) -> None:
        """Say something that was not said before, numbers aside."""
        known = _NUMBER.sub("#", sentence)
        if known not in self._told:
            self._told.add(known)
            self._tell_it(sentence)

    def run(self, *, once: bool = False) -> Tally:
        """Bridge until stopped, or with ``once`` until both sides hold what the other one has now.

        Raises
        ------
        BridgeError
            If the configuration does not fit, or either side refuses; ``once``: also ``Away``.
        """
        pause_s = PAUSE_S
        while not self._stop.is_set():
            try:
                with self._connect() as gateway:
                    self.tally.connections += 1
                    inward = Inward(self._config, gateway, self._side, self.tally, self.tell)
                    outward = Outward(self._config, gateway, self._side, self._reports, self.tally, self.tell)
                    try:
                        self._begin(inward, outward)
                        pause_s = PAUSE_S
                        if once:
                            inward.drain(0.2)
                            outward.settle()
                            break
                        self._follow(inward, outward)
                    finally:
                        inward.end()
                        outward.end()
            except Away as error:
                if once:
                    raise
                self.tell(str(error))
                self._stop.wait(pause_s)
                pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
        return self.tally

    def _begin(self, inward: Inward, outward: Outward) -> None:
        """Check both directions before anything flows, then fetch what was missed and find out what is published."""
        twin = self._side.detail()
        outward.check_published(twin)
        inward.begin(twin, first=self.tally.connections == 1)
        outward.begin(self._side.detail())
        self._forget("Yamcs at", "the service")

    def _follow(self, inward: Inward, outward: Outward) -> None:
        """Keep both sides in step until asked to stop; Away when something breaks."""
        looking: Iterator[None] | None = outward.publish_again()  # the archive was read a moment ago
        begun_s = due_s = time.monotonic()
        try:
            while not self._stop.is_set():
                inward.drain(self._poll_s if looking is None else 0.0)
                inward.check()
                if looking is None and time.monotonic() >= due_s:
                    begun_s, looking = time.monotonic(), self._look_again(inward, outward)
                if looking is not None and next(looking, _END) is _END:
                    took_s, looking = time.monotonic() - begun_s, None
                    due_s = begun_s + max(self._config.backfill.every_s, took_s / SHARE)
                outward.publish()
        except ServiceAway:
            with suppress(Away):  # where Yamcs is away as well, nobody can be told
                outward.tell_away()
            raise

    def _look_again(self, inward: Inward, outward: Outward) -> Iterator[None]:
        """Pass on what either side got late, step by step: what is live does not wait for the past."""
        yield from inward.backfill(self._side.detail())
        yield from outward.publish_again()

    def _forget(self, *beginnings: str) -> None:
        """Tell of the next interruption again."""
        self._told = {sentence for sentence in self._told if not sentence.startswith(beginnings)}
