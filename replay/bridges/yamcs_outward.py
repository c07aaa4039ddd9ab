"""The other direction of the bridge: forecasts, residuals, health and events of a twin into Yamcs."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from functools import partial

from replay.bridges.config import YamcsConfig
from replay.bridges.errors import Away, BridgeError
from replay.bridges.events import of_activations, of_alarms, of_anomalies, of_diagnoses
from replay.bridges.instants import now_ms, service_ms, to_text
from replay.bridges.twin_side import TwinSide
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
from service.schemas import Forecast, Residuals, TwinDetail

BATCH = 2000
"""Most rows sent to Yamcs in one request."""
ATTEMPTS = 3
"""How often the same rows are sent where the answer is lost; then the connection begins anew."""
PAUSE_S = 0.5


@dataclass
class Given:
    """What Yamcs has been given."""

    residual_rows: int = 0
    forecast_rows: int = 0
    published_values: int = 0
    events: int = 0


@dataclass
class Watermarks:
    """What is published: generation times of residual rows since ``since_ms``, the newest one and that of forecasts."""

    since_ms: int
    residuals: set[int] = field(default_factory=set)
    newest_ms: int = -1
    forecast_ms: int = -1
    events: set[str] = field(default_factory=set)

    def forget_before(self, time_ms: int) -> None:
        """Move the beginning of what is remembered on."""
        if time_ms > self.since_ms:
            self.since_ms = time_ms
            self.residuals = {t for t in self.residuals if t >= time_ms}


class Outward:
    """Publishes a twin through one connection to Yamcs."""

    def __init__(
        self,
        config: YamcsConfig,
        gateway: YamcsGateway,
        side: TwinSide,
        reports: str,
        tally: Given,
        tell: Callable[[str], None],
    ) -> None:
        """Publish nothing yet; ``reports`` is where the addresses of reports begin."""
        self._config, self._gateway, self._side, self._tally, self._tell = config, gateway, side, tally, tell
        self._reports, self._name = reports, partial(name_of, config)
        self._look_ms = round(1000 * config.backfill.look_back_s)
        self._issued_ms = -1
        self._asking = ThreadPoolExecutor(1, "forecast")
        self._asked: Future[Forecast | None] | None = None
        self._due_s = dict.fromkeys(("health", "events"), 0.0)

    def check_published(self, twin: TwinDetail) -> None:
        """Refuse to begin where Yamcs does not know what is to be published."""
        names = published_names(self._config, twin)
        lacking = sorted(set(names) - self._gateway.declared(names).keys())
        if lacking:
            raise BridgeError(
                f"{len(lacking)} of {len(names)} parameters to publish, such as {lacking[0]}, are unknown to the mission "
                "database; load what twin bridge xtce writes"
            )

    def begin(self, twin: TwinDetail) -> None:
        """Find out what is published already."""
        self._sensors = sensors_of(twin)
        newest_ms = service_ms(twin.last_time) if twin.last_time else now_ms()
        self._marks = Watermarks(newest_ms - self._look_ms)
        self._read_marks(min(newest_ms, now_ms()) - self._look_ms)

    def end(self) -> None:
        """Ask for nothing any more."""
        self._asking.shutdown(cancel_futures=True)

    def settle(self) -> None:
        """Publish all that there is now."""
        for _ in self.publish_again():
            pass
        self.publish()
        if self._asked is not None:
            wait([self._asked])
            self._publish_forecast()

    def publish_again(self) -> Iterator[None]:
        """Publish residuals of samples that came late, part by part."""
        self._marks.forget_before(self._marks.newest_ms - self._look_ms)
        for part in self._residuals(self._marks.since_ms):
            self._publish_part(part)
            yield

    def tell_away(self) -> None:
        """Let whoever watches Yamcs know that the service is away; Away if Yamcs is, too."""
        self._send([Row(now_ms(), {self._name(HEALTH): SERVICE_AWAY})])

    def _is_due(self, what: str, every_s: float) -> bool:
        now_s = time.monotonic()
        if now_s < self._due_s[what]:
            return False
        self._due_s[what] = now_s + every_s
        return True

    def publish(self) -> None:
        """Publish what is new."""
        newest_ms = self._marks.newest_ms
        for part in self._residuals(newest_ms + 1 if newest_ms >= 0 else self._marks.since_ms):
            self._publish_part(part)
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

    def _publish_part(self, part: Residuals) -> None:
        """Publish residuals, but for those whose generation time is there already."""
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
            part = self._side.ask(partial(self._side.client.residuals, self._side.twin, **span))
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
            question = partial(self._side.client.forecast, self._side.twin, lead_s, step_s=step_s)
            self._asked = self._asking.submit(self._side.ask, question)

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
        twin = self._side.detail()
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
        twin = self._side.twin
        start = to_text(self._events_from_ms)
        notes = [
            *of_anomalies(self._side.ask(lambda: self._side.client.anomalies(twin, start=start)) or []),
            *of_alarms(self._side.ask(lambda: self._side.client.alarms(twin)) or []),
            *of_activations(self._side.ask(lambda: self._side.client.activations(twin)) or []),
            *of_diagnoses(self._side.ask(lambda: self._side.client.jobs(twin, "diagnosis")) or [], self._reports),
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
