"""Pacing: a clock that can be replaced, so that tests of real-time replay take no time."""

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Clock:
    """A monotonic clock and a way to wait."""

    now_s: Callable[[], float] = time.monotonic
    sleep_s: Callable[[float], None] = time.sleep


class Pace:
    """Holds replay to ``rate`` recorded seconds per real second; None means as fast as possible."""

    def __init__(self, rate: float | None, clock: Clock | None = None) -> None:
        """Remember the rate; the pace starts with the first call of ``wait_for``."""
        if rate is not None and not rate > 0:
            raise ValueError(f"rate must be positive, got {rate:g}")
        self._rate = rate
        self._clock = clock or Clock()
        self._origin: tuple[float, int] | None = None

    def wait_for(self, instant_ns: int) -> None:
        """Return when the recorded instant is due."""
        if self._rate is None:
            return
        now_s = self._clock.now_s()
        if self._origin is None:
            self._origin = (now_s, instant_ns)
        started_s, first_ns = self._origin
        ahead_s = started_s + (instant_ns - first_ns) / 1e9 / self._rate - now_s
        if ahead_s > 0:
            self._clock.sleep_s(ahead_s)
