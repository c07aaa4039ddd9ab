"""What the store says when it cannot do what it is asked to."""

from service.errors import Refusal
from twin_core.errors import TwinError


class StoreError(TwinError):
    """The store cannot be opened."""


class TwinGone(LookupError):
    """The twin that a write concerns was deleted."""


class Missing(Refusal):
    """There is nothing of that name or number."""


class Conflicting(Refusal):
    """What is stored already stands against it."""


class DiskFull(Refusal):
    """There is no room for what was to be stored; nothing of it was."""


class Unavailable(Refusal):
    """The database cannot be reached; whether a write under way was stored is not known, and sending it again does no harm."""


class LeaseLost(Exception):
    """A write of somebody who no longer owns what it concerns; nothing of it was stored."""
