"""How far long work has come: each part of it tells its own fraction, and the whole hears its own."""

from dataclasses import dataclass

from twin_core._typing import Progress, no_progress


@dataclass(frozen=True, slots=True)
class Part:
    """A part of long work: called with its own fraction and a message, it tells those of the whole.

    It has no ``__dict__``: pieces of work that are forked from a search look no further into what hears of it.

    Attributes
    ----------
    whole
        Called with the fraction of the whole; may raise to cancel.
    start, stop
        Fractions of the whole at which this part begins and ends.
    words
        Put before each message.
    """

    whole: Progress = no_progress
    start: float = 0.0
    stop: float = 1.0
    words: str = ""

    def __call__(self, fraction: float, message: str) -> None:
        """Tell the whole."""
        self.whole(self.start + (self.stop - self.start) * fraction, self.words + message)

    def part(self, start: float, stop: float, words: str = "") -> "Part":
        """Return a part of this one."""
        return Part(self, start, stop, words)
