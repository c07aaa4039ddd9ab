"""The live state of every twin: one tracker each, and the engine they share."""

import contextlib
import copy
from collections.abc import Sequence

from service.errors import Refusal
from service.fleet.ownership import Ownership
from service.instants import now_us
from service.live import pulse as pulses
from service.live.engine import Engine
from service.live.known import Known, Stored
from service.live.limits import LimitWatch
from service.live.pulse import Beat, Overall, Pulse
from service.live.scores import Scores
from service.live.tracker import Tracker
from service.monitoring.metrics import Metrics
from service.store import fleet
from service.store.connection import Connection
from service.store.database import Database
from service.store.errors import TwinGone
from service.stream.hub import Hub
from service.twins.registry import Entry
from service.workbench.interface import Json, MakeWorkbench, Outcome
from twin_core.anomaly import Thresholds

AT_ONCE = 100
"""So many twins are looked at by one reader, before others have their turn."""


def _brought_up(connection: Connection, twins: Sequence[tuple[Entry, Pulse | None]]) -> dict[int, Pulse]:
    found = {}
    for twin, known in twins:
        with contextlib.suppress(TwinGone):
            found[twin.key] = pulses.brought_up(connection, twin.key, len(twin.channels), known)
    return found


class Live:
    """Every tracker of this service."""

    def __init__(
        self,
        database: Database,
        hub: Hub,
        metrics: Metrics,
        workbench: MakeWorkbench,
        false_alarm_rate: float,
        limit_horizon_s: float,
        window: int,
        ownership: Ownership,
    ) -> None:
        """Start without twins; a new model follows at most the newest ``window`` samples of the past."""
        self._window, self._ownership = window, ownership
        self.engine = Engine(workbench)
        self._database, self._hub, self._metrics = database, hub, metrics
        self._follows_elsewhere = database.is_shared
        self._thresholds = Thresholds(false_alarm_rate)
        self._trackers: dict[int, Tracker] = {}
        self._tenures: dict[int, int] = {}
        """Twin -> epoch that its tracker writes in."""
        self._pulses: dict[int, Pulse] = {}
        self.scores = Scores(database, self.engine)
        self._limits = LimitWatch(database, hub, self.engine, self.find, limit_horizon_s, ownership)

    def add(self, twin: Entry) -> bool:
        """Begin to track a twin, if it is not tracked and this process owns it; return whether that began now."""
        tenure = self._ownership.tenure(twin.key)
        is_new = tenure is not None and twin.key not in self._trackers
        if tenure is not None and is_new:
            rooms = (self._database, self._hub, self.engine, self._metrics)
            guard = self._ownership.guard(twin.key, tenure)
            self._trackers[twin.key] = Tracker(twin, *rooms, self._thresholds, self._window, guard)
            self._tenures[twin.key] = tenure
        return is_new

    def is_outlived(self, twin: Entry) -> bool:
        """Return whether the tracker of a twin can write no more: the tenure in which it began is over."""
        return twin.key in self._trackers and self._ownership.tenure(twin.key) != self._tenures[twin.key]

    async def let_go(self, twin: Entry) -> None:
        """Stop following a twin, which another process does now."""
        self._limits.forget(twin)
        tracker = self._trackers.pop(twin.key, None)
        self._tenures.pop(twin.key, None)
        if tracker is not None:
            await tracker.close()

    async def remove(self, twin: Entry) -> None:
        """Stop tracking a twin."""
        self._pulses.pop(twin.key, None)
        self.scores.forget(twin)
        await self.let_go(twin)

    def state(self, twin: Entry) -> Known:
        """Return what is known of the state of a twin; Refusal if nothing follows its samples.

        Where another process follows them, that is what it has written down.
        """
        tracker = self._trackers.get(twin.key)
        if tracker is None and self._follows_elsewhere:
            return Stored(twin, self._database)
        if tracker is None:
            raise Refusal(f"nothing follows the samples of '{twin.name}': TWIN_ASSIMILATE is off, or it was deleted")
        return tracker

    async def seen(self, twin: Entry) -> Known | None:
        """Return what is known of the state of a twin now, without waiting for it; None if nothing follows its samples."""
        tracker = self._trackers.get(twin.key)
        if not self._follows_elsewhere or (tracker is not None and tracker.active is not None):
            return tracker
        stored = Stored(twin, self._database)
        await stored.look()
        return stored

    async def beats(self, twin: Entry) -> dict[str, Beat]:
        """Return when each channel was last heard of, in their order."""
        known = copy.deepcopy(self._pulses.get(twin.key))  # readers run in threads, and requests beside each other
        pulse = await self._database.read(pulses.brought_up, twin.key, len(twin.channels), known)
        self._pulses[twin.key] = pulse
        return dict(zip(twin.channels, pulse.beats(), strict=True))

    async def beats_of(self, twins: Sequence[Entry]) -> dict[int, dict[str, Beat]]:
        """Return when each channel of twins was last heard of, in their order, by the twin's number.

        One look at the database tells which twins have changed: only those are looked at.
        """
        marks = await self._database.read(fleet.marks)
        changed = [twin for twin in twins if twin.key in marks and not self._is_known(twin, *marks[twin.key])]
        for first in range(0, len(changed), AT_ONCE):
            known = [(twin, copy.deepcopy(self._pulses.get(twin.key))) for twin in changed[first : first + AT_ONCE]]
            self._pulses |= await self._database.read(_brought_up, known)
        held = [(twin, self._pulses[twin.key]) for twin in twins if twin.key in marks and twin.key in self._pulses]
        return {twin.key: dict(zip(twin.channels, pulse.beats(), strict=True)) for twin, pulse in held}

    def _is_known(self, twin: Entry, seq: int, revision: int) -> bool:
        pulse = self._pulses.get(twin.key)
        return pulse is not None and (pulse.seq, pulse.revision) == (seq, revision)

    async def standings(self, twins: Sequence[Entry]) -> list[tuple[Overall, float | None]]:
        """Return how the sensors of twins stand, all of a twin together, and for how long nothing has arrived, in seconds."""
        beats, at_us = await self.beats_of(twins), now_us()
        return [
            pulses.overall([beat for name, beat in beats.get(twin.key, {}).items() if name in twin.sensor_names], at_us)
            for twin in twins
        ]

    def find(self, twin: int) -> Tracker | None:
        """Return the tracker of a twin, None if nothing follows its samples."""
        return self._trackers.get(twin)

    def evidence(self, twin: Entry) -> float | None:
        """Return the greatest log evidence against the active model of a twin; None where nothing is followed."""
        tracker = self._trackers.get(twin.key)
        return None if tracker is None else tracker.evidence

    def arrived(self, twin: Entry) -> None:
        """Pass on that samples were stored."""
        self._limits.arrived(twin)
        tracker = self._trackers.get(twin.key)
        if tracker is not None:
            tracker.arrived()

    def archive_changed(self, twin: Entry) -> None:
        """Pass on that stored samples were taken away."""
        self._limits.arrived(twin)
        tracker = self._trackers.get(twin.key)
        if tracker is not None:
            tracker.archive_changed()

    def shelved(self, twin: Entry) -> None:
        """Pass on that a limit was shelved, or taken up again."""
        self._limits.arrived(twin)

    def model_changed(self, twin: int) -> None:
        """Pass on that another model is active."""
        tracker = self._trackers.get(twin)
        if tracker is not None:
            tracker.model_changed()

    async def inspect(self, document: Json) -> Outcome:
        """Check a model that was made elsewhere."""
        return await self.engine.inspect(document)

    async def close(self) -> None:
        """Stop everything."""
        await self._limits.close()
        await self.scores.close()
        for tracker in self._trackers.values():
            await tracker.close()
        await self.engine.close()
