"""How an assimilation gets past samples that it cannot digest, and keeps late ones from taking all of its time."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.live.progress import BLOCK

QUICK_S = 1.0
"""A return to late samples that took longer is followed by a rest of the same length."""


@dataclass
class Caution:
    """How the tracker gets past samples that cannot be assimilated.

    A block that fails is tried again in halves, down to ``stride`` samples, which are skipped; each skip in a row
    doubles the stride. A stretch of n such samples thus costs about 2 log2(n) attempts and at most n good samples.
    """

    most: int = BLOCK
    stride: int = 1
    skipped: tuple[int, int] | None = None
    """The last instant that is skipped, and the number at which the stream stood then."""

    def failed(self, time_us: NDArray[np.int64], seq: int) -> bool:
        """Hear that these samples failed; return whether they are skipped from now on."""
        if time_us.size > self.stride:
            self.most = max(int(time_us.size) // 2, self.stride)
            return False
        self.skipped = (int(time_us[-1]), seq)
        self.most = self.stride = min(2 * self.stride, BLOCK)
        return True

    def succeeded(self) -> None:
        """Hear that a block was assimilated."""
        self.most, self.stride, self.skipped = min(2 * self.most, BLOCK), 1, None


@dataclass
class Rest:
    """The time after a long return to late samples, in which those that come late wait and are then taken in at once.

    A clock that stays wrong thus costs at most half of the time.
    """

    _loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop)
    _left_s: float | None = None
    _until_s: float = 0.0

    @property
    def lasts(self) -> bool:
        """Whether late samples have to wait; during a return they do not."""
        return self._left_s is None and self._loop.time() < self._until_s

    def leave(self) -> None:
        """Hear that the assimilation goes back to late samples."""
        if self._left_s is None:
            self._left_s = self._loop.time()

    def begin(self) -> None:
        """Hear that the present is reached."""
        if self._left_s is not None:
            took_s = self._loop.time() - self._left_s
            self._until_s = self._loop.time() + (took_s if took_s > QUICK_S else 0.0)
            self._left_s = None

    def then(self, wake: Callable[[], None]) -> None:
        """Call somebody at the end."""
        self._loop.call_at(self._until_s, wake)
