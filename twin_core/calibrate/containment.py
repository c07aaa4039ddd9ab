"""What ends one start or refinement, and never the run: failures of arithmetic, and the time that is up."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import TypeVar

from numpy.linalg import LinAlgError

from twin_core.side_by_side import side_by_side

NUMERICAL_FAILURES = (LinAlgError, ArithmeticError)
"""What a factorisation or an overflow raises. Errors of programming are none of them and end the run."""

NO_DEADLINE = float("inf")

T = TypeVar("T")

_limit: ContextVar[float] = ContextVar("limit", default=NO_DEADLINE)
_cpu_limit: ContextVar[float] = ContextVar("cpu_limit", default=NO_DEADLINE)


class TimeIsUpError(Exception):
    """A computation went on past its limit and was given up."""


@contextmanager
def limited(deadline: float, cpu_s: float = NO_DEADLINE) -> Iterator[None]:
    """Let :func:`check_time` raise in this thread from ``deadline`` on, or after some computing; a limit never extends another.

    Parameters
    ----------
    deadline
        On the clock of ``time.monotonic``.
    cpu_s
        Seconds that this thread may compute: unlike a deadline, the same work on a busy machine.
    """
    token = _limit.set(min(deadline, _limit.get()))
    cpu_token = _cpu_limit.set(min(time.thread_time() + cpu_s, _cpu_limit.get()))
    try:
        yield
    finally:
        _limit.reset(token)
        _cpu_limit.reset(cpu_token)


def check_time() -> None:
    """Raise TimeIsUpError where the time that :func:`limited` leaves is over.

    Iterations call it once each, and so does each segment and each stretch of an evaluation, which may be long.
    """
    cpu_limit = _cpu_limit.get()
    if is_late(_limit.get()) or (cpu_limit < NO_DEADLINE and time.thread_time() >= cpu_limit):
        raise TimeIsUpError("the deadline was reached")


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


def those_that_work(works: Sequence[Callable[[], T]]) -> list[T]:
    """Return what works return that do not fail numerically, done side by side; where all fail, the first failure is raised."""
    results = side_by_side([partial(_returned, work) for work in works])
    done = [result for result in results if not isinstance(result, Exception)]
    if not done:
        raise next(result for result in results if isinstance(result, Exception))
    return done


def _returned(work: Callable[[], T]) -> T | Exception:
    try:
        return work()
    except NUMERICAL_FAILURES as error:
        return error
