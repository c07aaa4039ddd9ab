"""The watch over limits: every new reading of a channel that has any, and now and then what a forecast says of it."""

import asyncio
import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from service.errors import Refusal
from service.fleet.ownership import Ownership
from service.instants import format_instant, in_words, now_us
from service.live import forecasts
from service.live.engine import Engine
from service.live.judging import MOST_PAST, Judge, in_units, is_beyond
from service.live.tracker import Tracker
from service.schemas import ForecastRequest
from service.store import alarms, events, samples
from service.store.alarms import FORECAST, MEASURED, AlarmRow, Limit
from service.store.connection import Connection
from service.store.database import Database
from service.store.errors import LeaseLost, TwinGone
from service.store.quarters import EVER_US
from service.store.samples import Samples
from service.stream.hub import Hub
from service.stream.messages import EventStretch, Stretch
from service.twins.registry import Entry
from service.workbench.interface import Forecasted
from twin_core.anomaly.limits import Ahead, reaches
from twin_core.errors import TwinError

log = logging.getLogger("service.live")

Json = dict[str, Any]

PAUSE_S = 0.2
"""Shortest time between two looks, so that samples sent one by one are watched together."""
FORECAST_EVERY_S = 60.0
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
STEPS = 180


def limits_of(twin: Entry, origin: str) -> list[Limit]:
    """Return the limits of a twin; forecast are temperatures only."""
    found = []
    for name, channel in twin.spec.channels.items():
        if channel.limits is None or (origin == FORECAST and name not in twin.sensors):
            continue
        for colour in ("yellow", "red"):
            for side, bound in zip(("low", "high"), getattr(channel.limits, colour) or (None, None), strict=True):
                if bound is not None:
                    found.append(Limit(origin, name, colour, side, float(bound)))
    return found


class LimitWatch:
    """Watches the twins that have limits."""

    def __init__(
        self,
        database: Database,
        hub: Hub,
        engine: Engine,
        find: Callable[[int], Tracker | None],
        horizon_s: float,
        ownership: Ownership,
    ) -> None:
        """Look ``horizon_s`` ahead; 0: not at all."""
        self._database, self._hub, self._engine, self._find = database, hub, engine, find
        self._horizon_s, self._ownership = horizon_s, ownership
        self._loop = asyncio.get_running_loop()
        self._due: dict[int, Entry] = {}
        self._foreseen_s: dict[int, float] = {}
        self._timers: dict[int, asyncio.TimerHandle] = {}
        self._without: set[int] = set()
        """Twins without limits, and without alarms of limits that they had."""
        self._wake = asyncio.Event()
        self._task = asyncio.create_task(self._run())

    def arrived(self, twin: Entry) -> None:
        """Hear that samples were stored, or taken away, or that a limit was shelved or taken up again."""
        if self._ownership.owns(twin.key) and (twin.key not in self._without or limits_of(twin, MEASURED)):
            self._due[twin.key] = twin
            self._wake.set()

    def forget(self, twin: Entry) -> None:
        """Watch a twin no longer."""
        self._due.pop(twin.key, None)
        self._foreseen_s.pop(twin.key, None)
        self._without.discard(twin.key)
        self._look_at(twin, None)

    async def close(self) -> None:
        """Stop."""
        self._task.cancel()
        await asyncio.wait([self._task])

    async def _run(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            due, self._due = self._due, {}
            for twin in due.values():
                try:
                    has_any = bool(limits_of(twin, MEASURED))
                    left = [] if has_any else await self._database.read(alarms.lasting, twin.key)
                    if has_any or left:
                        until_us = await self._hub.write(twin.key, self._ownership.guard(twin.key)(look), twin)
                        self._look_at(twin, until_us)
                    if not has_any:
                        self._without.add(twin.key)
                    await self._foresee(twin)
                except (TwinGone, LeaseLost):
                    continue
                except Exception:
                    log.exception("limits could not be watched", extra={"twin": twin.name})
            await asyncio.sleep(PAUSE_S)

    def _look_at(self, twin: Entry, at_us: int | None) -> None:
        """Look again at an instant of the clock, even if nothing arrives."""
        timer = self._timers.pop(twin.key, None)
        if timer is not None:
            timer.cancel()
        if at_us is not None:
            self._timers[twin.key] = self._loop.call_later(max(at_us - now_us(), 0) / 1e6, self.arrived, twin)

    async def _foresee(self, twin: Entry) -> None:
        """Look ahead, unless that was done just now."""
        tracker = self._find(twin.key)
        limits = limits_of(twin, FORECAST)
        if self._horizon_s == 0.0 or tracker is None or not limits:
            return
        wait_s = self._foreseen_s.get(twin.key, -FORECAST_EVERY_S) + FORECAST_EVERY_S - self._loop.time()
        if wait_s > 0.0:
            self._loop.call_later(wait_s, self.arrived, twin)
            return
        self._foreseen_s[twin.key] = self._loop.time()
        request = ForecastRequest(horizon_s=self._horizon_s, step_s=self._horizon_s / STEPS, quantiles=list(QUANTILES))
        try:
            found = await forecasts.look_ahead(tracker, self._database, self._engine, request)
        except (Refusal, TwinError):
            self._foreseen_s.pop(twin.key, None)
            return  # there is no state yet
        await self._hub.write(
            twin.key, self._ownership.guard(twin.key)(foresee), twin, limits, found.position.time_us, found.made
        )


def look(connection: Connection, twin: Entry) -> tuple[int | None, Sequence[Stretch]]:
    """Judge what arrived since the last look; return when to look again for an alarm that is shelved until then."""
    told = _told(connection, twin, _judged(connection, twin))
    return _taken_up_us(connection, twin), told


def _judged(connection: Connection, twin: Entry) -> list[AlarmRow]:
    """Judge what arrived since the last look, each channel by itself: none waits for the others, nor is passed by them."""
    seq, state = alarms.watched(connection, twin.key)
    latest, n = samples.latest_seq(connection, twin.key), len(twin.channels)
    if seq < 0:
        fresh = samples.newest(connection, twin.key, n, MOST_PAST)
    else:
        _, found = samples.since_seq(connection, twin.key, n, seq)
        order = np.argsort(found.time_us, kind="stable")
        fresh = Samples(found.time_us[order], found.values[:, order])
    news = _lapsed(connection, twin)
    taken = state.get("taken")
    if not fresh.time_us.size and taken is None:
        return news
    marks: dict[str, int] = state.get("marks", {})
    before_us: int = state.get("time_us", -EVER_US)  # what earlier releases noted for all channels together
    after: Json = {"marks": {}, "untold": state.get("untold", [])}
    lasting = {row.limit: row for row in alarms.lasting(connection, twin.key)}
    for limit in limits_of(twin, MEASURED):
        judge = Judge(connection, twin, limit, lasting.get(limit))
        key = f"{limit.channel}/{limit.colour}/{limit.side}/{limit.bound!r}"
        judge.resume(state.get(key, {}), marks.get(limit.channel, before_us))
        if taken is not None:
            judge.taken(*taken)
        judge.arrived(fresh.time_us, fresh.values)
        after[key], after["marks"][limit.channel] = judge.state, judge.mark_us
        news += judge.news
    alarms.watch(connection, twin.key, latest, after)
    return news


def _lapsed(connection: Connection, twin: Entry) -> list[AlarmRow]:
    """End the alarms whose limit the specification has no more, or has elsewhere, at the end of the archive."""
    limits = {limit for origin in (MEASURED, FORECAST) for limit in limits_of(twin, origin)}
    places = {(limit.origin, limit.channel, limit.colour, limit.side) for limit in limits}
    ended = []
    for row in alarms.lasting(connection, twin.key):
        if row.limit not in limits:
            place = (row.limit.origin, row.limit.channel, row.limit.colour, row.limit.side)
            why = "the limit was changed" if place in places else "the limit was removed"
            last_us = samples.last_us(connection, twin.key)
            ended.append(alarms.end(connection, twin.key, row.id, row.start_us if last_us is None else last_us, why))
    return ended


def foresee(
    connection: Connection, twin: Entry, limits: Sequence[Limit], from_us: int, made: Forecasted
) -> tuple[None, Sequence[Stretch]]:
    """Raise an alarm where a limit is reached in half of the futures; end it where it is in less than a quarter."""
    lasting = {row.limit: row for row in alarms.lasting(connection, twin.key)}
    news: list[AlarmRow] = []
    for limit in limits:
        known = lasting.get(limit)
        is_there = Limit(MEASURED, limit.channel, limit.colour, limit.side, limit.bound) in lasting
        ahead, may = reached(limit, from_us, made)
        if known is not None and (is_there or not may):
            news.append(alarms.end(connection, twin.key, known.id, from_us))
        elif not is_there and (known is not None or ahead.expected_s is not None):
            body = describe(limit, twin.units[limit.channel], from_us, ahead)
            body["message"] += f", as of {format_instant(from_us // 1_000_000 * 1_000_000)}"  # read at any time after
            start_us = from_us if known is None else known.start_us
            row = alarms.write(connection, twin.key, limit, start_us, None, body)
            news += [] if row is None else [row]
    return None, _told(connection, twin, news)


def reached(limit: Limit, from_us: int, made: Forecasted) -> tuple[Ahead, bool]:
    """Return when a forecast reaches a limit, and whether a quarter of the futures at least do."""
    time_s = (made.time_us - from_us) / 1e6
    quantiles = {q: columns[limit.channel] for q, columns in made.quantiles.items()}
    ahead = reaches(time_s, quantiles, limit.bound, limit.side)  # type: ignore[arg-type]
    outer = quantiles.get(0.75 if limit.side == "high" else 0.25)
    may = outer is not None and bool((outer >= limit.bound if limit.side == "high" else outer <= limit.bound).any())
    return ahead, may


def expected(twin: Entry, from_us: int, made: Forecasted, lasting: Collection[Limit]) -> Iterator[Json]:
    """Yield what a forecast says of each limit that it may reach, in one future of twenty at least.

    A limit that is behind already, by the state or by an alarm of those that last, is said to be.
    """
    whole = made.since(from_us)
    for limit in limits_of(twin, FORECAST):
        ahead, _ = reached(limit, from_us, whole)
        is_there = replace(limit, origin=MEASURED) in lasting or ahead.expected_s == 0.0
        if is_there:
            ahead = Ahead(0.0, 0.0, 0.0)
        if ahead.earliest_s is not None:
            unit = twin.units[limit.channel]
            place = {"channel": limit.channel, "colour": limit.colour, "side": limit.side, "limit": limit.bound}
            says = {"message": f"{is_beyond(limit, unit)} already"} if is_there else {}
            yield place | describe(limit, unit, from_us, ahead) | says


def describe(limit: Limit, unit: str | None, from_us: int, ahead: Ahead) -> Json:
    """Return in words and instants when a limit is reached."""

    def when(seconds: float | None) -> str | None:
        return None if seconds is None else format_instant(from_us + round(seconds) * 1_000_000)

    bound = in_units(limit, unit)
    if ahead.expected_s is None:
        first = "" if ahead.earliest_s is None else f" in {in_words(ahead.earliest_s)} at the earliest"
        message = f"{limit.channel} may reach {bound}{first}"
    else:
        latest = "after the end of the forecast" if ahead.latest_s is None else in_words(ahead.latest_s)
        message = f"{limit.channel} reaches {bound} in {in_words(ahead.expected_s)}"
        message += f" (90 %: {in_words(ahead.earliest_s or 0.0)} to {latest})"
    ends = {"expected": ahead.expected_s, "earliest": ahead.earliest_s, "latest": ahead.latest_s}
    return {"unit": unit, "message": message} | {name: when(seconds) for name, seconds in ends.items()}


def _told(connection: Connection, twin: Entry, news: Sequence[AlarmRow]) -> Sequence[Stretch]:
    """Return the messages that tell of alarms; of those that are shelved others hear once they are not, if they still last."""
    seq, state = alarms.watched(connection, twin.key)
    at_us, lasting = now_us(), {row.id: row for row in alarms.lasting(connection, twin.key)}
    before: list[int] = state.get("untold", [])
    began = [row.id for row in news if row.stop_us is None]
    untold = [number for number in (*before, *began) if number in lasting and lasting[number].is_shelved(at_us)]
    if untold != before:
        alarms.watch(connection, twin.key, seq, state | {"untold": untold})
    due = [lasting[number] for number in before if number in lasting]
    messages = [("alarm", {"alarm": row.wire()}) for row in (*due, *news) if not row.is_shelved(at_us)]
    if not messages:
        return ()
    return [EventStretch(tuple(events.append(connection, twin.key, now_us(), messages)))]


def _taken_up_us(connection: Connection, twin: Entry) -> int | None:
    """Return when the first alarm that lasts and was not told of is shelved no more."""
    _, state = alarms.watched(connection, twin.key)
    untold = state.get("untold", [])
    until = (row.shelved_until_us for row in alarms.lasting(connection, twin.key) if row.id in untold)
    return min((until_us for until_us in until if until_us is not None), default=None)
