"""Errors: one root, few children. Every message names the field, row or node and says what to do."""

from collections.abc import Sequence


class TwinError(Exception):
    """Wrong input or an impossible request. The command line shows it in one line and exits with 2."""


class SpecError(TwinError):
    """A field of a specification, scenario or model file is wrong; ``problems`` are all that is, the message the first.

    Each problem is one line, ``field: what is wrong and what to do``, without the file's name.
    """

    def __init__(self, message: str, problems: Sequence[str] = ()) -> None:
        """Keep the headline and all problems; the headline alone where no list is given."""
        super().__init__(message)
        self.problems = tuple(problems) or (message,)


class PluginError(TwinError):
    """A plug-in with effects cannot be used: its file or package is named, and what to do."""


class TelemetryError(TwinError):
    """A telemetry file, row or channel is wrong."""


class ModelError(TwinError):
    """A request that the network or the model cannot answer, such as a node that does not exist."""


class ArgumentError(ModelError):
    """An argument of a function is out of range. The command line names its own option instead of ``argument``."""

    def __init__(self, argument: str, reason: str) -> None:
        """Keep both; the message is ``argument: reason``."""
        super().__init__(argument, reason)
        self.argument, self.reason = argument, reason

    def __str__(self) -> str:
        """Return the message."""
        return f"{self.argument}: {self.reason}"


class NoSolutionError(ModelError):
    """The declared model has no solution from any start: the command line shows it in one line and exits with 1."""


class PrecisionError(ModelError, ArithmeticError):
    """Numbers that double precision cannot hold together. In a search it ends one fit, as any failure of arithmetic does."""


class Cancelled(TwinError):
    """A long job was asked to stop."""
