"""What ends one start or refinement, and never the run: failures of arithmetic, and the time that is up."""

import time
from collections.abc import Callable
from typing import TypeVar

from numpy.linalg import LinAlgError

NUMERICAL_FAILURES = (LinAlgError, ArithmeticError)
"""What a factorisation or an overflow raises. Errors of programming are none of them and end the run."""

NO_DEADLINE = float("inf")

T = TypeVar("T")


def is_late(deadline: float) -> bool:
    """Return whether ``deadline``, on the clock of ``time.monotonic``, has passed."""
    return time.monotonic() >= deadline


def attempted(work: Callable[[], T], what: str, failures: list[str]) -> T | None:
    """Return what ``work`` returns, or None where it fails numerically: the reason is added to ``failures``."""
    try:
        return work()
    except NUMERICAL_FAILURES as error:
        failures.append(f"{what}: {error}" if str(error) else f"{what}: {type(error).__name__}")
        return None
