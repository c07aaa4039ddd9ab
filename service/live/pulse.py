"""Is telemetry live? When each channel was last heard of, by the clock of this machine, and whether that is long ago."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.store import samples
from service.store.batch import Batch
from service.store.connection import Connection

STALE = 10.0
"""In usual intervals of a channel: one that has been silent for longer is stale."""
LEAST_STALE_S = 60.0
"""But not before so many seconds: samples travel, and arrive in batches."""
LATE_S = 3600.0
"""A twin whose readings are older than this when they arrive is fed from a recording, or long after the fact."""
RECENT = 12
"""So many of the last readings tell a channel's usual interval."""

MOST = 200_000
"""At most so many samples are looked through for a channel that has been silent for long."""

Standing = Literal["live", "delayed", "stale", "never"]
Overall = Literal["live", "delayed", "stale", "partly", "never"]


@dataclass(frozen=True)
class Beat:
    """What is known of one channel.

    Attributes
    ----------
    last_us
        Instant of its newest reading; None where there is none.
    received_us
        When that arrived; None where nobody noted it.
    interval_s
        Usual distance of its readings; None where there are fewer than two.
    """

    last_us: int | None
    received_us: int | None
    interval_s: float | None

    def silent_s(self, now_us: int) -> float | None:
        """Return for how long nothing has arrived, in seconds; None where that is not known."""
        return None if self.received_us is None else max(now_us - self.received_us, 0) / 1e6

    @property
    def delay_s(self) -> float | None:
        """How old the newest reading was when it arrived, in seconds; None where that is not known."""
        if self.last_us is None or self.received_us is None:
            return None
        return max(self.received_us - self.last_us, 0) / 1e6

    @property
    def stale_after_s(self) -> float:
        """After so many seconds of silence a channel is stale."""
        return max(STALE * (self.interval_s or 0.0), LEAST_STALE_S)

    def standing(self, now_us: int) -> Standing:
        """Return ``live``, ``delayed`` (it arrives, but long after the fact), ``stale`` or ``never``."""
        silent_s, delay_s = self.silent_s(now_us), self.delay_s
        if self.last_us is None:
            return "never"
        if silent_s is None or silent_s > self.stale_after_s:
            return "stale"
        return "delayed" if delay_s is not None and delay_s > max(LATE_S, self.stale_after_s) else "live"


class Pulse:
    """The newest readings of every channel of a twin, up to a number of its stream."""

    def __init__(self, n_channels: int, revision: int) -> None:
        """Know nothing yet of an archive of this revision."""
        self.seq, self.revision = -1, revision
        self._instants_us: list[list[int]] = [[] for _ in range(n_channels)]
        self._received_us = [0] * n_channels
        self._beats: list[Beat] | None = None

    def hear(self, batch: Batch) -> None:
        """Take in samples in any order; of each channel the newest readings count."""
        self._beats = None
        finite = np.isfinite(batch.values)
        for row in np.flatnonzero(finite.any(axis=1)).tolist():
            instants, received = batch.time_us[finite[row]], batch.received[finite[row]]
            known, newest = self._instants_us[row], int(instants.max())
            if not known or newest > known[-1]:
                self._received_us[row] = int(received[int(np.argmax(instants))])
            some = np.partition(instants, max(instants.size - RECENT, 0))[-RECENT:].tolist()
            self._instants_us[row] = sorted({*known, *some})[-RECENT:]

    @property
    def is_complete(self) -> bool:
        """Whether every channel has been heard often enough to tell its interval."""
        return all(len(known) >= RECENT for known in self._instants_us)

    def may_learn(self, last_us: int) -> bool:
        """Whether samples up to an instant can tell anything that is not known."""
        return not self.is_complete or last_us > min(known[0] for known in self._instants_us)

    def beats(self) -> list[Beat]:
        """Return what is known of each channel, in their order."""
        if self._beats is None:
            self._beats = list(self._made())
        return self._beats

    def _made(self) -> Iterator[Beat]:
        for known, received_us in zip(self._instants_us, self._received_us, strict=True):
            interval_s = float(np.median(np.diff(known))) / 1e6 if len(known) > 1 else None
            yield Beat(known[-1] if known else None, received_us or None, interval_s)


def listed(names: Sequence[str]) -> str:
    """Return channels as one says them, five by name at most."""
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def overall(sensors: Sequence[Beat], at_us: int) -> tuple[Overall, float | None]:
    """Return how the sensors of a twin stand, all of them together, and for how long nothing has arrived, in seconds."""
    silent_s = min((s for beat in sensors if (s := beat.silent_s(at_us)) is not None), default=None)
    states = {beat.standing(at_us) for beat in sensors}
    if states <= {"never"}:
        return "never", silent_s
    if states <= {"stale", "never"}:
        return "stale", silent_s
    if "stale" in states:
        return "partly", silent_s
    return "delayed" if "delayed" in states else "live", silent_s


def brought_up(connection: Connection, twin: int, n_channels: int, known: Pulse | None) -> Pulse:
    """Return what is known of every channel now, given what was known before.

    The first time the archive is looked through backwards, until each channel was heard often enough or for ``MOST`` samples.
    """
    revision, seq = samples.revision(connection, twin), samples.latest_seq(connection, twin)
    pulse = known if known is not None and known.revision == revision else Pulse(n_channels, revision)
    looked = 0
    for batch in samples.newest_first(connection, twin, n_channels, pulse.seq, pulse.may_learn):
        pulse.hear(batch)
        looked += int(batch.time_us.size)
        if pulse.seq < 0 and (pulse.is_complete or looked >= MOST):
            break
    pulse.seq = seq
    return pulse
