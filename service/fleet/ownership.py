"""Who follows which twin: this process alone, or a fleet that shares the twins among its processes."""

import time
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from service.store import ownership
from service.store.connection import Connection
from service.store.ownership import LEASE_S, Holding, slot_of

P = ParamSpec("P")
T = TypeVar("T")

BEAT_S = 1.0


class Guard(Protocol):
    """The right to write the live state of one twin; it ends with the lease."""

    def __call__(
        self, operation: Callable[Concatenate[Connection, P], T], /
    ) -> Callable[Concatenate[Connection, P], T]:
        """Return the operation, which raises LeaseLost instead of writing once the right has ended."""


class Ownership(Protocol):
    """Who follows which twin."""

    def owns(self, twin: int) -> bool:
        """Return whether this process follows a twin now."""

    def tenure(self, twin: int) -> int | None:
        """Return the epoch in which this process follows a twin now; None if it does not."""

    def guard(self, twin: int, tenure: int | None = None) -> Guard:
        """Return the right to write what follows from the samples of a twin, in a tenure or else in the present one."""

    @property
    def leads(self) -> bool:
        """Whether what one process does for all is this one's business now."""


def _unguarded(operation: Callable[..., Any], /) -> Callable[..., Any]:
    return operation


class Alone:
    """One process, which owns everything."""

    leads = True

    def owns(self, twin: int) -> bool:
        """Return True."""
        return True

    def tenure(self, twin: int) -> int:
        """Return the only one there is."""
        return 0

    def guard(self, twin: int, tenure: int | None = None) -> Guard:
        """Return what lets everything pass."""
        return _unguarded  # type: ignore[return-value]


class _Fenced:
    """Lets writes pass as long as the epoch is the present one, which the database knows."""

    def __init__(self, twin: int, epoch: int) -> None:
        self._twin, self._epoch = twin, epoch

    def __call__(self, operation: Callable[..., Any], /) -> Callable[..., Any]:
        twin, epoch = self._twin, self._epoch

        def checked(connection: Connection, *args: Any, **kwargs: Any) -> Any:
            ownership.check(connection, twin, epoch)
            return operation(connection, *args, **kwargs)

        return checked


class Leases:
    """What this process owns, for as long as its own clock says that the leases last.

    Only durations are measured, from before the request that renewed the leases: clocks of different machines may disagree.
    """

    def __init__(self) -> None:
        """Own nothing."""
        self._holding = Holding({}, 1)
        self._until_s = 0.0
        self._seen: dict[int, int] = {}

    def hold(self, holding: Holding, asked_s: float) -> None:
        """Take over what a renewal that was asked for at a monotonic time brought."""
        self._holding, self._until_s = holding, asked_s + LEASE_S

    def changed(self) -> bool:
        """Return whether the last renewal brought or took anything since this was asked."""
        seen, self._seen = self._seen, self._holding.epochs
        return seen != self._seen

    @property
    def epochs(self) -> dict[int, int]:
        """Slot -> epoch of what is owned now."""
        return self._holding.epochs if time.monotonic() < self._until_s else {}

    @property
    def leads(self) -> bool:
        """Whether the first slot is owned."""
        return 0 in self.epochs

    def owns(self, twin: int) -> bool:
        """Return whether this process follows a twin now."""
        return slot_of(twin) in self.epochs

    def tenure(self, twin: int) -> int | None:
        """Return the epoch in which this process follows a twin now; None if it does not."""
        return self.epochs.get(slot_of(twin))

    def guard(self, twin: int, tenure: int | None = None) -> Guard:
        """Return the right to write for a twin in a tenure, or in the present one; one that is not owned lets nothing pass."""
        return _Fenced(twin, self._holding.epochs.get(slot_of(twin), -1) if tenure is None else tenure)
