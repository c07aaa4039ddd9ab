"""The tracker of one twin: every sample updates the state of the active model; late ones send it back a little."""

import asyncio
import logging
from dataclasses import dataclass, replace

from service.fleet.ownership import Guard
from service.instants import format_instant
from service.live import progress
from service.live.caution import Caution, Rest
from service.live.engine import Engine
from service.live.following import Followed, Following, NotFollowed
from service.live.position import Position, is_far, next_count
from service.live.progress import Outdated, Reading
from service.live.scout import Base, Scout
from service.monitoring import tracing
from service.monitoring.metrics import Metrics
from service.store import models
from service.store.database import Database
from service.store.errors import DiskFull, LeaseLost, TwinGone, Unavailable
from service.store.models import Active
from service.store.samples import Samples
from service.stream.hub import Hub
from service.twins.registry import Entry
from twin_core.anomaly import Thresholds

log = logging.getLogger("service.live")

PAUSE_S = 0.05
"""Shortest time between two steps, so that samples sent one by one are assimilated together."""
RETRY_S = 2.0
SHORT = 10_000
"""If more samples are to be assimilated, a scout goes ahead, so that the present is known in seconds."""
SCOUTED = 4
"""Most blocks of the newest samples that are followed between two blocks of the archive."""
_EVER = -(2**62)


@dataclass(frozen=True)
class _Detour:
    """A return to late samples that ends where a long gap does: behind it the state starts anew, so all there stays true,
    unless an input that came late holds there.

    ``back`` is where the assimilation goes on afterwards, with what was read until then; ``n_samples`` is how many
    there had been where the detour began.
    """

    until_us: int
    back: Position
    read: list[tuple[int, int, int]]
    n_samples: int


class Tracker:
    """Keeps one twin's state up to date in the background."""

    def __init__(
        self,
        twin: Entry,
        database: Database,
        hub: Hub,
        engine: Engine,
        metrics: Metrics,
        thresholds: Thresholds,
        window: int,
        guard: Guard,
    ) -> None:
        """Start in the background; the state comes from the last checkpoint, and is written as long as a guard lets it.

        Where a model is to follow more than ``window`` samples of the past, it follows the newest of them only.
        """
        self._window = window
        self.floor_us: int | None = None
        """The assimilation looks at nothing before this instant; None: it began with the archive."""
        self.twin = twin
        self.active: Active | None = None
        self.waits_us: int | None = None
        """Instant of a lone sample far ahead of the others, which waits for company; None if there is none."""
        self.trouble: str | None = None
        self.catching_up = False
        self._database, self._hub, self._guard = database, hub, guard
        self._metrics = metrics
        self._following = Following(twin, database, engine, thresholds)
        self._scout: Scout | None = None
        self._passed: Position | None = None
        """The farthest position that a return to late samples left behind."""
        self.left = 0
        """About so many samples are still to be assimilated."""
        self._caution = Caution()
        self._at: Position | None = None
        self._read: list[tuple[int, int, int]] = []
        """What was read of the archive, see ``look``."""
        self._detour: _Detour | None = None
        self._rest = Rest()
        self._told_seq, self._new_model, self._begin_anew = 0, True, False
        self._wake, self._idle = asyncio.Event(), asyncio.Event()
        self._wake.set()
        self._task = asyncio.create_task(self._run())
        self._task.add_done_callback(lambda _: self._idle.set())  # nobody waits for what does not come

    @property
    def position(self) -> Position | None:
        """The latest known state: that of the assimilation, of a scout, or where it goes on after a detour."""
        back = None if self._detour is None else self._detour.back
        scouted = None if self._scout is None else self._scout.position
        known = [p for p in (self._at, back, scouted) if p is not None]
        return max(known, key=lambda position: position.time_us, default=None)

    @property
    def base(self) -> Base | None:
        """How much of the past the latest state rests on; None where that is the whole archive."""
        scout = self._scout
        return scout.base if scout is not None and scout.position is self.position is not None else None

    @property
    def evidence(self) -> float | None:
        """The greatest log evidence against the active model so far; None where nothing is followed."""
        known = None if self._at is None else self._at.state.get("evidence")
        return None if known is None else float(known["most"])

    def arrived(self) -> None:
        """Hear that samples were stored."""
        self._idle.clear()
        self._wake.set()

    def model_changed(self) -> None:
        """Hear that another model is active."""
        self._new_model = True
        self._idle.clear()
        self._wake.set()

    def archive_changed(self) -> None:
        """Hear that stored samples were taken away: go back to before them."""
        self._begin_anew = True
        self.model_changed()

    async def settled(self, timeout_s: float) -> bool:
        """Return whether everything stored when this was asked is assimilated, after waiting for it a while.

        The database is asked what that is: word of a model or of samples comes after their commit, from another process later
        still, and whoever saw the commit may ask before it comes. A tracker that has ended, since another process follows the
        twin now, assimilates nothing more.
        """
        seq, version = await self._database.read(progress.stands, self.twin.key)
        if version != (None if self.active is None else self.active.version):
            self.model_changed()
        elif seq > self._told_seq and self._scout is None:  # a scout hears of samples between two blocks of the archive
            self.arrived()
        if self._task.done():
            return False
        try:
            async with asyncio.timeout(timeout_s):
                await self._idle.wait()
        except TimeoutError:
            return False
        return not self._task.done()

    async def close(self) -> None:
        """Stop."""
        self._task.cancel()
        await asyncio.wait([self._task])

    async def _run(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            try:
                await self._take_in()
            except (TwinGone, LeaseLost):
                return
            except (Unavailable, DiskFull) as error:
                extra = {"twin": self.twin.name, "reason": type(error).__name__}
                log.warning("assimilation waits for the database", extra=extra)
                await self._try_again()
            except Exception as error:
                self.trouble = f"{type(error).__name__}: {error}"
                log.exception("assimilation failed unexpectedly", extra={"twin": self.twin.name})
                await self._try_again()
            if not self._wake.is_set():
                self._idle.set()
            await asyncio.sleep(PAUSE_S)

    async def _try_again(self) -> None:
        """Wait a little before the next attempt, to which everything is still to be done."""
        self._wake.set()
        await asyncio.sleep(RETRY_S)

    async def _take_in(self) -> None:
        if self._new_model:
            await self._load()
        while self.active is not None and await self._go_on(self.active):
            if self._new_model:
                await self._load()

    async def _go_on(self, active: Active) -> bool:
        """Assimilate the next block, and what came meanwhile; return whether there may be more."""
        try:
            if not await self._advance(active):
                return False
            if self._scout is not None:
                await self._look_ahead(self._scout)
        except Outdated:
            self._new_model = self._begin_anew = True
        return True

    async def _look_ahead(self, scout: Scout) -> None:
        """Let the scout follow what came meanwhile."""
        self._wake.clear()
        for _ in range(SCOUTED):
            if self._new_model:  # or the same one told of twice, which must not cost the look ahead
                await self._load()
            if self._scout is not scout:
                return
            if not await scout.advance(self._told_seq):
                break
        else:
            return
        if not self._wake.is_set():
            self._idle.set()

    async def _load(self) -> None:
        """Find the active model and where its assimilation stands; what fails is to be done again."""
        self._new_model, anew, self._begin_anew = False, self._begin_anew, False
        try:
            await self._find(anew)
        except Exception:
            self._new_model, self._begin_anew = True, anew or self._begin_anew
            raise

    async def _find(self, anew: bool) -> None:
        """Take over the active model and its last checkpoint, unless it is followed already and not to begin anew."""
        active = await self._database.read(models.active, self.twin.key)
        if active is None:
            self.active, self.catching_up, self._detour = None, False, None
            self._scout, self._passed, self.left = None, None, 0
            self._stand(None)
            return
        if self.active is not None and self.active.version == active.version and not anew:
            return
        checkpoint, self._told_seq, self.floor_us = await self._database.read(
            progress.resume, self.twin, active.version
        )
        if checkpoint is None:
            await self._lift_floor(active, _EVER)
        self._caution, self.trouble, self.catching_up = Caution(), None, True
        self._detour, self.waits_us, self._rest = None, None, Rest()
        self._scout, self._passed = None, None
        self._stand(None if checkpoint is None else Position.of(checkpoint))
        self.active = active

    async def _lift_floor(self, active: Active, from_us: int) -> None:
        """Leave out of what lies behind an instant all but the newest samples."""
        arguments = (self.twin, active.version, self._window, from_us)
        self.floor_us = await self._database.write_to(self.twin.key, self._guard(progress.lift_floor), *arguments)

    def _stand(self, position: Position | None) -> None:
        """Go on from a position, up to which the archive was read when the stream stood at its number."""
        self._at = position
        self._read = [] if position is None else [(_EVER, position.time_us, position.seq)]

    async def _advance(self, active: Active) -> bool:
        """Assimilate the next block, or go back to before a late sample; return whether there may be more."""
        before, caution, detour = self._at, self._caution, self._detour
        read = self._read
        if caution.skipped is not None:
            read = [*read, (read[-1][1] if read else _EVER, *caution.skipped)]
        until_us = None if detour is None else detour.until_us
        reading = await self._database.read(
            progress.look,
            self.twin,
            read,
            self._told_seq,
            max(caution.most, 2),
            active.longest_gap_us,
            until_us,
            self.floor_us,
        )
        if reading.late_us is not None and not self._rest.lasts:
            self._caution = Caution()
            if before is not None and reading.late_us <= before.time_us:
                await self._go_back(active, before, reading.late_us, reading.until_us)
            return True
        self.left = reading.left
        if self._scout is None and self.left > SHORT:
            self.catching_up = True
            self._scout = await self._send_scout(active)
            return True
        time_us = reading.fresh.time_us
        count = next_count(time_us, active.longest_gap_us)
        if detour is None and count == time_us.size > 0 and is_far(time_us, before, active.longest_gap_us):
            count -= 1
        if count == 0 and detour is not None:
            await self._return(active, detour, reading.seq)
            return True
        if count == 0:
            self._rest.begin()
            if reading.late_us is not None:
                self._rest.then(self._wake.set)
            self._told_seq, self.catching_up = reading.seq, False
            self._scout, self._passed, self.left = None, None, 0
            self._wait(int(time_us[0]) if time_us.size else None)
            return False
        self.catching_up |= reading.fresh.time_us.size >= progress.BLOCK
        kept = slice(0, min(count, caution.most))
        fresh = Samples(reading.fresh.time_us[kept], reading.fresh.values[:, kept])
        if before is None and self.floor_us is not None:
            fresh = await self._following.opened(Samples(fresh.time_us, fresh.values.copy()))
        try:
            with tracing.part("filter", _told(self.twin, active, fresh), cause=self.twin.key):
                done = await self._following.filter(active, before, fresh)
        except NotFollowed as error:
            self.trouble = str(error)
            if caution.failed(fresh.time_us, reading.seq):
                self._metrics.skipped.inc(int(fresh.time_us.size))
                extra = {"twin": self.twin.name, "reason": self.trouble, "samples": int(fresh.time_us.size)}
                log.warning("samples that cannot be assimilated are skipped", extra=extra)
            return True
        caution.succeeded()
        self.trouble = None
        seq = before.seq if before is not None and reading.late_us is not None else reading.seq
        await self._keep(active, before, done, seq, reading)
        return True

    async def _send_scout(self, active: Active) -> Scout:
        """Return a scout that goes on from where the assimilation has been before, or else looks for the present."""
        scout = Scout(self.twin, self._database, self._hub, self._following, active, self._guard)
        if self._passed is not None:
            scout.seed(self._passed)
        else:
            await scout.begin()
        return scout

    async def _go_back(self, active: Active, before: Position, late_us: int, until_us: int | None) -> None:
        """Go back to before a late sample, and in a detour, if a long gap lies between it and here."""
        self._rest.leave()
        await self._lift_floor(active, late_us)
        if self.floor_us is not None:
            late_us = max(late_us, self.floor_us)
            if until_us is not None and late_us >= until_us:
                return  # all of it lies before what is looked at
        if self._passed is None or self._passed.time_us < before.time_us:
            self._passed = before
        if self._detour is not None:
            until_us = self._detour.until_us
        arguments = (self.twin, active.version, late_us, until_us)
        checkpoint = await self._database.write_to(self.twin.key, self._guard(progress.rewind), *arguments)
        if self._detour is None and until_us is not None:
            self._detour = _Detour(until_us, before, self._read, 0 if checkpoint is None else checkpoint.n_samples)
        self._stand(None if checkpoint is None else Position.of(checkpoint))

    async def _return(self, active: Active, detour: _Detour, seq: int) -> None:
        """End a detour: the archive before its end was read when the stream stood at ``seq``.

        Where an input that came late holds on behind it, the assimilation goes on from here instead.
        """
        done, back = self._at, detour.back
        if await self._database.read(progress.outdates_inputs, self.twin, detour.read, detour.until_us):
            checkpoint = await self._database.write_to(
                self.twin.key, self._guard(progress.rewind), self.twin, active.version, detour.until_us, None
            )
            self._detour, self._caution = None, Caution()
            self._stand(None if checkpoint is None else Position.of(checkpoint))
            return
        if done is not None:
            arguments = (self.twin, active.version, done.time_us, detour.until_us)
            await self._hub.write(self.twin.key, self._guard(progress.end_record), *arguments)
            back = replace(back, n_samples=back.n_samples + done.n_samples - detour.n_samples)
        self._detour, self._caution = None, Caution()
        self._stand(back)
        last_us = detour.until_us - 1
        beyond = [(max(after, last_us), until, number) for after, until, number in detour.read if until > last_us]
        self._read = [(_EVER, last_us, seq), *beyond]

    def _wait(self, instant_us: int | None) -> None:
        """Note that a lone sample waits for company, or that none does."""
        if instant_us is not None and instant_us != self.waits_us:
            extra = {"twin": self.twin.name, "sample": format_instant(instant_us)}
            log.warning("a lone sample far ahead of the others waits for company", extra=extra)
        self.waits_us = instant_us

    async def _keep(self, active: Active, before: Position | None, done: Followed, seq: int, reading: Reading) -> None:
        """Look for anomalies in a filtered block and write everything down."""
        time_us = done.seen.time_us
        after_us = _EVER if before is None else before.time_us
        scouted = None if self._scout is None else self._scout.position
        told = (reading.told[: time_us.size] | (time_us == self.waits_us)) & (
            time_us > (_EVER if scouted is None else scouted.time_us)
        )
        after, step = self._following.step(active, before, after_us, done, seq, told, reading.revision)
        await self._hub.write(self.twin.key, self._guard(progress.save), self.twin, step)
        self._metrics.assimilated.inc(int(time_us.size))
        self.left = max(self.left - int(time_us.size), 0)
        self._stand(after)


def _told(twin: Entry, active: Active, fresh: Samples) -> dict[str, tracing.Value]:
    """Return what a trace tells of a block that is filtered."""
    counts = {"thermal_twin.samples": int(fresh.time_us.size), "thermal_twin.model_version": active.version}
    return {"thermal_twin.twin": twin.name, **counts}
