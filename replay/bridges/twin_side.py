"""What both directions of the bridge ask the service, and what its refusals mean."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from replay.bridges.errors import Away, BridgeError, ServiceAway
from service.client import ApiError, TwinClient, Unreachable
from service.schemas import TwinDetail

T = TypeVar("T")


@dataclass(frozen=True)
class TwinSide:
    """One twin of the service."""

    client: TwinClient
    twin: str

    def detail(self) -> TwinDetail:
        """Return the twin; Away or BridgeError if the service does not answer or refuses."""
        return self.sure(lambda: self.client.twin(self.twin))

    def sure(self, question: Callable[[], T]) -> T:
        """Return an answer; Away or BridgeError if there is none."""
        try:
            return question()
        except (ApiError, Unreachable) as error:
            raise _unless_permanent(error) from error

    def ask(self, question: Callable[[], T]) -> T | None:
        """Return an answer, None where there is none yet (no model, nothing assimilated)."""
        try:
            return question()
        except ApiError as error:
            if error.status in (404, 409):
                return None
            raise _unless_permanent(error) from error
        except Unreachable as error:
            raise _unless_permanent(error) from error


def _unless_permanent(error: ApiError | Unreachable) -> Away | BridgeError:
    """Return what an error of the service is to the bridge: refusals stay, overload and silence pass."""
    if isinstance(error, ApiError) and error.status < 500 and error.status not in (408, 429):
        return BridgeError(f"the service refuses: {error.detail}")
    return ServiceAway(f"the service does not answer: {error}")
