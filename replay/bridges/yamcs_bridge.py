"""The bridge itself: telemetry from Yamcs into a twin, forecasts, residuals and events of the twin into Yamcs.

It keeps nothing on disk. What the service holds and what Yamcs holds are asked for whenever a connection begins, so a
restart on either side, or of the bridge, loses nothing and repeats nothing: samples that come again are recognised by the
service, events by Yamcs, and of published rows those are left out whose generation time is there already.
"""

import queue
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from replay.bridges.config import YamcsConfig
from replay.bridges.errors import Away, BridgeError, ServiceAway
from replay.bridges.events import of_activations, of_alarms, of_anomalies, of_diagnoses
from replay.bridges.instants import now_ms, parse_utc_ms, service_ms, to_text
from replay.bridges.yamcs_gateway import Row, YamcsGateway
from replay.bridges.yamcs_names import (
    CATCHING_UP,
    HEALTH,
    HEALTHY,
    ISSUED_BY,
    NIS,
    NO_MODEL,
    SERVICE_AWAY,
    STALE,
    VERSION,
    name_of,
    published_names,
    sensors_of,
)
from replay.bridges.yamcs_wiring import Wiring, wire
from service.client import ApiError, TwinClient, Unreachable
from service.schemas import Forecast, Residuals, TwinDetail

BATCH = 2000
"""Most rows sent in one request, in either direction."""
ATTEMPTS = 3
"""How often the same rows are sent where the answer is lost; then the connection begins anew."""
PAUSE_S, LONGEST_PAUSE_S = 0.5, 15.0
HELD = 200_000
"""Rows of the subscription that may wait; beyond them the connection begins anew and fetches from the archive."""

T = TypeVar("T")
_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass
class Tally:
    """What a bridge has done so far."""

    samples: int = 0
    accepted: int = 0
    duplicates: int = 0
    rejected: int = 0
    quarantined: int = 0
    residual_rows: int = 0
    forecast_rows: int = 0
    published_values: int = 0
    events: int = 0
    connections: int = 0


@dataclass
class Watermarks:
    """What is published: generation times of residual rows since ``since_ms``, the newest one and that of forecasts."""

    since_ms: int
    residuals: set[int] = field(default_factory=set)
    newest_ms: int = -1
    forecast_ms: int = -1
    events: set[str] = field(default_factory=set)


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
        self._config, self._connect, self._client = config, connect, client
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
                    session = _Session(self, self._config, gateway, self._client, self._reports)
                    try:
                        session.begin(first=self.tally.connections == 1)
                        pause_s = PAUSE_S
                        self._forget("Yamcs at", "the service")
                        if once:
                            session.settle()
                            break
                        session.follow(self._poll_s, self._stop)
                    finally:
                        session.end()
            except Away as error:
                if once:
                    raise
                self.tell(str(error))
                self._stop.wait(pause_s)
                pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
        return self.tally

    def _forget(self, *beginnings: str) -> None:
        """Tell of the next interruption again."""
        self._told = {sentence for sentence in self._told if not sentence.startswith(beginnings)}


class _Session:
    """One connection to Yamcs, from its beginning until something breaks."""

    def __init__(
        self, bridge: YamcsBridge, config: YamcsConfig, gateway: YamcsGateway, client: TwinClient, reports: str
    ) -> None:
        self._bridge, self._config, self._gateway, self._client = bridge, config, gateway, client
        self._reports, self._tally, self._tell = reports, bridge.tally, bridge.tell
        self._name = partial(name_of, config)
        self._subscription: Any = None
        self._inbox: queue.Queue[Row] = queue.Queue(HELD)
        self._overrun = threading.Event()
        self._issued_ms = -1
        self._asking = ThreadPoolExecutor(1, "forecast")
        self._asked: Future[Forecast | None] | None = None
        self._due_s = dict.fromkeys(("rescan", "health", "events"), 0.0)

    def begin(self, *, first: bool) -> None:
        """Check names and units, subscribe, fetch what was missed, and find out what is published already."""
        twin = self._twin()
        names = [source.name for source in self._config.parameters.values()]
        self._wiring = self._wire(twin, names, first)
        self._check_published(twin)
        self._sensors = sensors_of(twin)
        self._subscription = self._gateway.subscribe(list(self._wiring.feeds), self._hear)
        self._backfill(twin)
        twin = self._twin()
        look_ms = round(1000 * self._config.backfill.look_back_s)
        newest_ms = service_ms(twin.last_time) if twin.last_time else now_ms()
        self._marks = Watermarks(newest_ms - look_ms)
        self._read_marks(min(newest_ms, now_ms()) - look_ms)

    def settle(self) -> None:
        """Publish all that there is now."""
        self._drain(0.2)
        self._publish_all()
        if self._asked is not None:
            wait([self._asked])
            self._publish_forecast()

    def end(self) -> None:
        """Hear nothing any more."""
        if self._subscription is not None:
            self._subscription.cancel()
        self._asking.shutdown(cancel_futures=True)

    def follow(self, poll_s: float, stop: threading.Event) -> None:
        """Keep both sides in step until asked to stop; Away when something breaks."""
        try:
            self._follow(poll_s, stop)
        except ServiceAway:
            with suppress(Away):  # whoever watches Yamcs is to know
                self._send([Row(now_ms(), {self._name(HEALTH): SERVICE_AWAY})])
            raise

    def _follow(self, poll_s: float, stop: threading.Event) -> None:
        while not stop.is_set():
            self._drain(poll_s)
            if self._overrun.is_set():
                raise Away("Yamcs sends more than the service takes; going on from its archive")
            if self._subscription.done():
                raise Away(f"Yamcs at {self._gateway.url}: the subscription broke off")
            if self._is_due("rescan", self._config.backfill.every_s):
                self._backfill(self._twin())
                self._publish_residuals(self._marks.since_ms)
            self._publish_all()

    def _is_due(self, what: str, every_s: float) -> bool:
        now_s = time.monotonic()
        if now_s < self._due_s[what]:
            return False
        self._due_s[what] = now_s + every_s
        return True

    # Telemetry, from Yamcs to the twin

    def _wire(self, twin: TwinDetail, names: Sequence[str], first: bool) -> Wiring:
        wiring = wire(self._config, twin, self._gateway.declared(names))
        if wiring.faults and first:
            raise BridgeError("; ".join(wiring.faults))
        for fault in wiring.faults:  # the mission database changed meanwhile: what still fits goes on
            self._tell(f"{fault}; it is left out")
        return wiring

    def _check_published(self, twin: TwinDetail) -> None:
        """Refuse to begin where Yamcs does not know what is to be published."""
        names = published_names(self._config, twin)
        lacking = sorted(set(names) - self._gateway.declared(names).keys())
        if lacking:
            raise BridgeError(
                f"{len(lacking)} of {len(names)} parameters to publish, such as {lacking[0]}, are unknown to the mission "
                "database; load what twin bridge xtce writes"
            )

    def _hear(self, row: Row) -> None:
        try:
            self._inbox.put_nowait(row)
        except queue.Full:
            self._overrun.set()

    def _drain(self, wait_s: float) -> None:
        """Send what arrived, waiting for the first row at most so long."""
        rows: list[Row] = []
        try:
            rows.append(self._inbox.get(timeout=wait_s))
            while len(rows) < BATCH:
                rows.append(self._inbox.get_nowait())
        except queue.Empty:
            pass
        self._ingest(rows)

    def _backfill(self, twin: TwinDetail) -> None:
        """Fetch from Yamcs' archive what the twin may lack: all of it at first, then the recent past."""
        start = self._config.backfill.start
        first_ms = parse_utc_ms(start) if start else None
        if twin.last_time is not None:
            recent_ms = service_ms(twin.last_time) - round(1000 * self._config.backfill.look_back_s)
            first_ms = recent_ms if first_ms is None else max(first_ms, recent_ms)
        if first_ms is None:
            return
        rows: list[Row] = []
        for row in self._gateway.history(list(self._wiring.feeds), first_ms):
            rows.append(row)
            if len(rows) == BATCH:
                self._ingest(rows)
                rows = []
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
        try:
            report = self._client.ingest(self._config.twin, [to_text(t) for t in times], columns)
        except (ApiError, Unreachable) as error:
            raise _unless_permanent(error) from error
        self._tally.samples += len(times)
        self._tally.accepted += report.accepted
        self._tally.duplicates += report.duplicates
        self._tally.rejected += len(report.rejected)
        self._tally.quarantined += len(report.quarantined)
        for reason, count in Counter(item.reason for item in report.rejected).items():
            self._tell(
                f"{count} sample(s) refused by the service, the first at {times[report.rejected[0].index]}: {reason}"
            )
        if report.quarantined:
            self._tell(
                f"samples from {to_text(times[report.quarantined[0].index])} on lie ahead of the service's clock"
            )

    # Forecasts, residuals and events, from the twin to Yamcs

    def _publish_all(self) -> None:
        self._publish_residuals(self._marks.newest_ms + 1 if self._marks.newest_ms >= 0 else self._marks.since_ms)
        self._publish_forecast()
        if self._is_due("health", self._config.health_s):
            self._publish_health()
        if self._is_due("events", 2.0):
            self._publish_events()

    def _read_marks(self, events_from_ms: int) -> None:
        marks = self._marks
        version, issued_by = self._name(VERSION), self._name(ISSUED_BY)
        for row in self._gateway.history([version, issued_by], marks.since_ms, now_ms() + 40 * 86_400_000):
            if version in row.values:
                marks.residuals.add(row.time_ms)
            if issued_by in row.values:
                marks.forecast_ms = max(marks.forecast_ms, row.time_ms)
        marks.newest_ms = max(marks.residuals, default=-1)
        marks.events = self._gateway.event_keys(self._config.source, events_from_ms)
        self._events_from_ms = events_from_ms

    def _publish_residuals(self, start_ms: int) -> None:
        for part in self._residuals(start_ms):
            rows = []
            spread = part.model_extra["std_K"] if part.model_extra else {}
            for k, text in enumerate(part.time):
                time_ms = service_ms(text)
                if time_ms in self._marks.residuals:
                    continue
                values: dict[str, float | str] = {self._name(VERSION): float(part.model_version[k])}
                for sensor in self._sensors:
                    for what, columns in (("residual", part.residual_K), ("residual_sigma", spread)):
                        value = columns[sensor][k]
                        if value is not None:
                            values[self._name(sensor, what)] = value
                nis = part.nis[k]
                if nis is not None:
                    values[self._name(NIS)] = nis
                rows.append(Row(time_ms, values))
            self._send(rows)
            self._marks.residuals.update(row.time_ms for row in rows)
            self._marks.newest_ms = max([self._marks.newest_ms, *(row.time_ms for row in rows)])
            self._tally.residual_rows += len(rows)

    def _residuals(self, start_ms: int) -> Iterable[Residuals]:
        """Yield what the service holds from an instant on, in the order of time, in parts that it gives out whole."""
        stop_ms = now_ms() + 400 * 86_400_000  # a twin of a simulation may lie ahead
        spans = [(start_ms, stop_ms)]
        while spans:
            first_ms, last_ms = spans.pop()
            span = {"start": to_text(first_ms), "stop": to_text(last_ms)}
            part = self._ask(partial(self._client.residuals, self._config.twin, **span))
            if part is None:
                return
            if not part.downsampled:
                yield part
                continue
            middle_ms = (first_ms + last_ms) // 2
            spans += [(middle_ms, last_ms), (first_ms, middle_ms)]

    def _publish_forecast(self) -> None:
        """Ask for a forecast whenever time has gone on by a step, and publish it once it is there; residuals do not wait."""
        if self._asked is not None and self._asked.done():
            asked, self._asked = self._asked, None
            made = asked.result()
            if made is not None:
                self._publish_expected(made)
        step_ms = round(1000 * self._config.forecast.step_s)
        if self._asked is None and self._marks.newest_ms >= self._issued_ms + step_ms:
            self._issued_ms = self._marks.newest_ms
            lead_s, step_s = self._config.forecast.lead_s, self._config.forecast.step_s
            question = partial(self._client.forecast, self._config.twin, lead_s, step_s=step_s)
            self._asked = self._asking.submit(self._ask, question)

    def _publish_expected(self, made: Forecast) -> None:
        """Publish what is expected at instants that no published forecast has reached yet: nothing is revised."""
        for notice in made.notices:
            self._tell(f"forecast: {notice}")
        rows = []
        for k, text in enumerate(made.time):
            time_ms = service_ms(text)
            if time_ms <= self._marks.forecast_ms:
                continue
            values: dict[str, float | str] = {self._name(ISSUED_BY): float(made.model_version)}
            for sensor, found in made.values.items():
                for what, key in (("forecast", "mean"), ("q05", "q05"), ("q95", "q95")):
                    values[self._name(sensor, what)] = found[key][k]
            rows.append(Row(time_ms, values))
        self._send(rows)
        self._marks.forecast_ms = max([self._marks.forecast_ms, *(row.time_ms for row in rows)])
        self._tally.forecast_rows += len(rows)

    def _publish_health(self) -> None:
        twin = self._twin()
        states = {twin.telemetry[name].state for name in self._sensors if name in twin.telemetry}
        health = HEALTHY
        if twin.active_model is None:
            health = NO_MODEL
        elif twin.catching_up:
            health = CATCHING_UP
        elif states <= {"stale", "never"}:
            health = STALE
        self._send([Row(now_ms(), {self._name(HEALTH): health})])

    def _publish_events(self) -> None:
        twin = self._config.twin
        start = to_text(self._events_from_ms)
        notes = [
            *of_anomalies(self._ask(lambda: self._client.anomalies(twin, start=start)) or []),
            *of_alarms(self._ask(lambda: self._client.alarms(twin)) or []),
            *of_activations(self._ask(lambda: self._client.activations(twin)) or []),
            *of_diagnoses(self._ask(lambda: self._client.jobs(twin, "diagnosis")) or [], self._reports),
        ]
        fresh = [n for n in notes if n.key not in self._marks.events and n.time_ms >= self._events_from_ms]
        for note in sorted(fresh, key=lambda n: n.time_ms):
            self._again(partial(self._gateway.send_event, self._config.source, note))
            self._marks.events.add(note.key)
            self._tally.events += 1

    def _send(self, rows: Sequence[Row]) -> None:
        """Publish rows: what is newer than anything before as it happens, the rest as a dump of the past."""
        newest_ms = self._marks.newest_ms
        for stream, some in (
            (self._config.dump_stream, [row for row in rows if row.time_ms < newest_ms]),
            (self._config.stream, [row for row in rows if row.time_ms >= newest_ms]),
        ):
            for first in range(0, len(some), BATCH):
                part = some[first : first + BATCH]
                self._again(partial(self._gateway.publish, stream, part))
                self._tally.published_values += sum(len(row.values) for row in part)

    def _again(self, send: Callable[[], object]) -> None:
        """Send the very same thing again while the answer is lost: Yamcs recognises it."""
        for attempt in range(ATTEMPTS):
            try:
                send()
                return
            except Away:
                if attempt + 1 == ATTEMPTS:
                    raise
                time.sleep(PAUSE_S)

    # The service

    def _twin(self) -> TwinDetail:
        try:
            return self._client.twin(self._config.twin)
        except (ApiError, Unreachable) as error:
            raise _unless_permanent(error) from error

    def _ask(self, question: Callable[[], T]) -> T | None:
        """Return an answer, None where there is none yet (no model, nothing assimilated)."""
        try:
            return question()
        except ApiError as error:
            if error.status in (404, 409):
                return None
            raise _unless_permanent(error) from error
        except Unreachable as error:
            raise _unless_permanent(error) from error


def _unless_permanent(error: ApiError | Unreachable) -> Away | BridgeError:
    """Return what an error of the service is to the bridge: refusals stay, overload and silence pass."""
    if isinstance(error, ApiError) and error.status < 500 and error.status not in (408, 429):
        return BridgeError(f"the service refuses: {error.detail}")
    return ServiceAway(f"the service does not answer: {error}")
