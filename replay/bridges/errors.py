"""Errors of the bridges: what is wrong for good, and what may be tried again."""

from replay.errors import ReplayError


class BridgeError(ReplayError):
    """The configuration is wrong, or the other side refuses: trying again does not help."""


class Away(ReplayError):
    """The other side does not answer now; it may later."""


class ServiceAway(Away):
    """It is the service that does not answer."""


class BadTimeError(BridgeError):
    """The time of one row is none, or lies where nothing can be told of it."""

    def __init__(self, name: str, row: int, fault: str, line: int | None = None) -> None:
        """Keep the row, counted from 0; it is told by its line in the file where that is known, from 1 otherwise."""
        super().__init__(f"{name}: row {row + 1 if line is None else line}: {fault}")
        self.name, self.row, self.fault = name, row, fault

    def on_line(self, line: int) -> "BadTimeError":
        """Return the same error with the line of its row in the file."""
        return BadTimeError(self.name, self.row, self.fault, line)
