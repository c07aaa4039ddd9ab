"""One measured limit against the archive: readings as they come, and those that come late."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.store import alarms, samples
from service.store.alarms import AlarmRow, Limit
from service.store.connection import Connection
from service.store.quarters import EVER_US
from service.twins.registry import Entry
from twin_core._typing import Json
from twin_core.anomaly.limits import LEAST_BAND, NOISES, Crossing, watch
from twin_core.quality.sentinels import marked
from twin_core.units import to_si

MOST_PAST = 100_000
"""Of an archive that nobody has watched so far, so many of the newest samples are looked through; after a deletion no more."""
SETTLING = 10_000
"""So many samples behind late ones are looked through again at first, more where an alarm still lasts there."""
BACK_US = (3_600_000_000, 86_400_000_000)
"""The reading before a late one is looked for so far back."""

Readings = tuple[NDArray[np.int64], NDArray[np.float64]]


class Judge:
    """Follows one limit of a twin, beside the alarm that lasts there.

    ``state`` is that of the newest reading, ``mark_us`` its instant, and ``news`` the alarms that others are to hear of.
    """

    def __init__(self, connection: Connection, twin: Entry, limit: Limit, lasting: AlarmRow | None) -> None:
        """Begin without readings."""
        self._connection, self._twin, self._limit, self._lasting = connection, twin, limit, lasting
        self._column, self._unit = twin.channels.index(limit.channel), twin.units[limit.channel]
        noise = twin.spec.channels[limit.channel].noise_std
        self._band = LEAST_BAND if noise is None else NOISES * float(noise)
        self._sign = 1.0 if limit.side == "high" else -1.0
        self.state: Json = {}
        self.mark_us = -EVER_US
        self.news: list[AlarmRow] = []

    def resume(self, state: Json, mark_us: int) -> None:
        """Go on from where the last look ended; the alarm of the store counts."""
        self.state = state | {"start": None if self._lasting is None else self._lasting.start_us}
        self.mark_us = mark_us

    def taken(self, start_us: int, stop_us: int) -> None:
        """Let go of what stood on readings that were taken out of the archive; the past is not told again."""
        for row in alarms.between(self._connection, self._twin.key, self._limit, start_us, stop_us):
            if row.stop_us is not None and not self._between(row.start_us, row.stop_us)[0].size:
                alarms.remove(self._connection, self._twin.key, row.id)
        if self._lasting is not None:
            self._stand_on_what_is_left(self._lasting, start_us)
        elif self.state.get("first") is not None and not self._has(self.state["first"]):
            self.state = {}
        if start_us <= self.mark_us < stop_us and not self._has(self.mark_us):
            self.mark_us = start_us - 1

    def _stand_on_what_is_left(self, row: AlarmRow, taken_us: int) -> None:
        """Go on with an alarm that lasts where the readings that are left still say so, and end it where they do not."""
        newest_us = samples.nth_newest_us(self._connection, self._twin.key, MOST_PAST)
        from_us = row.start_us if newest_us is None else max(row.start_us, newest_us)
        has_begun = self._has(row.start_us) or from_us > row.start_us
        worst = 0.0 if from_us == row.start_us else self._sign * (row.body["worst"] - self._limit.bound)
        before: Json = {"start": row.start_us, "worst": worst} if has_begun else {}
        state, crossings = self._watch(before, *self._between(from_us, self.mark_us + 1))
        if state["start"] is not None:
            start_us = row.start_us if has_begun else crossings[0].start
            farthest = [self._sign * crossing.worst for crossing in crossings]
            body = self._body(self._sign * max(farthest)) if farthest else row.body
            self._lasting = alarms.change(self._connection, self._twin.key, row.id, start_us, None, body)
        else:
            back_us, why = (crossings[-1].stop, None) if crossings else (None, "its readings were taken away")
            stop_us = max(taken_us, row.start_us) if back_us is None else back_us
            self.news.append(alarms.end(self._connection, self._twin.key, row.id, stop_us, why))
            self._lasting = None
        self.resume(state, self.mark_us)

    def arrived(self, time_us: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Judge what arrived since the last look, (n_channels, n_times) in the order of time."""
        instants, readings = self._valid(time_us, values[self._column])
        late = instants <= self.mark_us
        if late.any() and self._look_again(instants[late]):
            return
        self._follow(instants[~late], readings[~late])

    def _follow(self, instants: NDArray[np.int64], readings: NDArray[np.float64]) -> None:
        """Go on with newer readings."""
        if not instants.size:
            return
        self.state, crossings = self._watch(self.state, instants, readings)
        self.mark_us = int(instants[-1])
        for crossing in crossings:
            if self._lasting is None:
                self._begin(crossing)
            else:
                self._change(self._lasting, crossing.start, crossing.stop, crossing.worst)

    def _look_again(self, late_us: NDArray[np.int64]) -> bool:
        """Judge late readings in their place among the others; return whether that went on to the newest reading."""
        first_us, last_us, rows = int(late_us[0]), int(late_us[-1]), SETTLING
        around = alarms.between(self._connection, self._twin.key, self._limit, first_us, first_us)
        before: Json = {}
        if around:
            worst = self._sign * (around[0].body["worst"] - self._limit.bound)
            before = {"start": around[0].start_us, "worst": worst}
        while True:
            stop_us = samples.block_stop(self._connection, self._twin.key, last_us, rows)
            instants, readings = self._with_one_before(first_us, stop_us)
            state, crossings = self._watch(before, instants, readings)
            is_open = state["start"] is not None
            if stop_us is None or not is_open:
                break
            if alarms.between(self._connection, self._twin.key, self._limit, stop_us, stop_us):
                break  # an alarm that is known already lasts there
            rows *= 10
        for crossing in crossings:
            self._take_in(crossing)
        if stop_us is not None:
            self.resume(self.state, self.mark_us)
            return False
        over = [crossing for crossing in crossings if crossing.stop is not None]
        if self._lasting is not None and not is_open and over:
            self._change(self._lasting, self._lasting.start_us, over[-1].stop, over[-1].worst)
        self.resume(state if is_open == (self._lasting is not None) else {}, max(self.mark_us, int(instants[-1])))
        return True

    def _take_in(self, crossing: Crossing) -> None:
        """Write down a stay that was found among late readings: one that overlaps a known alarm only makes that longer."""
        stop_us = EVER_US if crossing.stop is None else crossing.stop
        known = alarms.between(self._connection, self._twin.key, self._limit, crossing.start, stop_us)
        if not known:
            self._begin(crossing)
            return
        row = known[-1] if known[-1].stop_us is None else known[0]
        if row.stop_us is not None and crossing.stop is None:
            return  # what others were told to be over stays so; the next readings may begin a new one
        start_us = min(row.start_us, crossing.start)
        longer_us = None if row.stop_us is None else max(row.stop_us, stop_us)
        self._change(row, start_us, longer_us, crossing.worst, is_news=False)

    def _begin(self, crossing: Crossing) -> None:
        body = self._body(crossing.worst)
        row = alarms.write(self._connection, self._twin.key, self._limit, crossing.start, crossing.stop, body)
        if row is not None:
            self.news.append(row)
            self._lasting = row if row.stop_us is None else self._lasting

    def _change(self, row: AlarmRow, start_us: int, stop_us: int | None, worst: float, *, is_news: bool = True) -> None:
        """Let an alarm go on or end; others hear of the end."""
        farthest = max(worst, row.body["worst"], key=lambda value: self._sign * value)
        changed = alarms.change(self._connection, self._twin.key, row.id, start_us, stop_us, self._body(farthest))
        if stop_us is not None and is_news:
            self.news.append(changed)
        if self._lasting is not None and self._lasting.id == row.id:
            self._lasting = changed if stop_us is None else None

    def _watch(
        self, state: Json, instants: NDArray[np.int64], readings: NDArray[np.float64]
    ) -> tuple[Json, Sequence[Crossing]]:
        return watch(state, self._limit.bound, self._limit.side, self._band, instants, readings)  # type: ignore[arg-type]

    def _valid(self, time_us: NDArray[np.int64], column: NDArray[np.float64]) -> Readings:
        """Return the readings without those that are missing or mark missing ones."""
        there = np.isfinite(column)
        if self._unit in ("K", "degC"):
            there &= ~marked(to_si(column, self._unit), self._unit)
        return time_us[there], column[there]

    def _with_one_before(self, first_us: int, stop_us: int | None) -> Readings:
        """Return the readings of the archive from an instant on, and the last one before it, which may be half of an alarm."""
        for back_us in BACK_US:
            instants, readings = self._between(first_us - back_us, stop_us)
            before = int(np.searchsorted(instants, first_us))
            if before:
                break
        return instants[max(before - 1, 0) :], readings[max(before - 1, 0) :]

    def _has(self, instant_us: int) -> bool:
        return bool(self._between(instant_us, instant_us + 1)[0].size)

    def _between(self, start_us: int, stop_us: int | None) -> Readings:
        held = samples.select(
            self._connection, self._twin.key, len(self._twin.channels), [self._column], start_us, stop_us
        )
        return self._valid(held.time_us, held.values[0])

    def _body(self, worst: float) -> Json:
        message = f"{is_beyond(self._limit, self._unit)}: {worst:.4g} at worst"
        return {"unit": self._unit, "worst": worst, "message": message}


def in_units(limit: Limit, unit: str | None) -> str:
    """Return a limit as an operator says it."""
    return f"its {limit.colour} limit of {limit.bound:g} {'°C' if unit == 'degC' else unit or ''}".rstrip()


def is_beyond(limit: Limit, unit: str | None) -> str:
    """Say that a limit is behind."""
    return f"{limit.channel} is {'above' if limit.side == 'high' else 'below'} {in_units(limit, unit)}"
