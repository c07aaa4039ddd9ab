"""Channels that fall silent, and speak again, are told once: to the stream, and by it to webhooks."""

import asyncio
import contextlib
import logging
from collections.abc import Mapping

from service.errors import Refusal
from service.fleet.ownership import Alone, Ownership
from service.instants import in_words, now_us
from service.jobs import outcome
from service.live.live import Live
from service.live.pulse import Beat, listed
from service.store.errors import LeaseLost, TwinGone
from service.stream.hub import Hub
from service.twins.registry import Entry, Registry

log = logging.getLogger("service.live")

LOOK_EVERY_S = 10.0


class Silence:
    """Looks at every twin now and then; after a start it tells of what is silent then."""

    def __init__(self, registry: Registry, live: Live, hub: Hub, ownership: Ownership | None = None) -> None:
        """Begin at once."""
        self._ownership = ownership or Alone()
        self._registry, self._live, self._hub = registry, live, hub
        self._silent: dict[int, frozenset[str]] = {}
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        """Stop."""
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(LOOK_EVERY_S)
            owned = [twin for twin in self._registry if self._ownership.owns(twin.key)]
            self._silent = {twin.key: self._silent.get(twin.key, frozenset()) for twin in owned}
            try:
                beats = await self._live.beats_of(owned)
            except Refusal as error:
                log.info("nobody can tell which channels are silent", extra={"reason": error.detail})
                continue
            for twin in owned:
                if twin.key not in beats:
                    continue
                try:
                    await self.look(twin, beats[twin.key])
                except (TwinGone, LeaseLost):
                    self._silent.pop(twin.key, None)
                except Exception:
                    log.exception("nobody can tell which channels are silent", extra={"twin": twin.name})

    async def look(self, twin: Entry, beats: Mapping[str, Beat] | None = None) -> None:
        """Tell which channels of a twin fell silent since the last look, and which ones are heard again."""
        beats = beats or await self._live.beats(twin)
        at_us = now_us()
        silent = frozenset(
            name
            for name, beat in beats.items()
            if beat.standing(at_us) == "stale" and (name in twin.sensors or beat.interval_s is not None)
        )  # an input that was sent once is a setting: nobody expects it again
        before = self._silent.get(twin.key, frozenset())
        self._silent[twin.key] = silent
        messages = []
        if fallen := sorted(silent - before):
            ages = [age for name in fallen if (age := beats[name].silent_s(at_us)) is not None]
            since = f" for {in_words(max(ages))}" if ages else ""
            text = f"no telemetry of {listed(fallen)}{since}"
            messages.append(("stale", {"state": "stale", "channels": fallen, "text": text}))
        if back := sorted(before - silent):
            messages.append(("stale", {"state": "live", "channels": back, "text": f"{listed(back)} reports again"}))
        if messages:
            await self._hub.write(twin.key, self._ownership.guard(twin.key)(outcome.tell), twin.key, messages)
