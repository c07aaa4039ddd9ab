"""Errors of the bridges: what is wrong for good, and what may be tried again."""

from replay.errors import ReplayError


class BridgeError(ReplayError):
    """The configuration is wrong, or the other side refuses: trying again does not help."""


class Away(ReplayError):
    """The other side does not answer now; it may later."""


class ServiceAway(Away):
    """It is the service that does not answer."""
