"""What computes jobs: every task runs in a process of its own, which can be ended at any moment.

``ProcessPoolExecutor`` shares processes between tasks, and a worker that dies or is ended takes the whole pool with
it. Here a task that crashes, hangs or is cancelled harms nobody else.
"""

import contextlib
import importlib
import math
import multiprocessing
import multiprocessing.connection
import os
import re
import signal
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event, Thread
from typing import Any, Generic, TypeVar

from service.memory import give_back, keep_freed
from twin_core._typing import Progress, no_progress
from twin_core.errors import TwinError

T = TypeVar("T")

APART_BYTES = 16 * 2**20
"""What a job frees of this size goes back to the system at once; by itself the allocator keeps ever larger pieces, up to 32 MB.
The diagnosis of 20,833 samples of 12 sensors takes 745 MiB with it, 827 with a quarter of it, 1,054 without.
"""

END_GRACE_S = 2.0
POLL_S = 0.2
NICENESS = 15
"""How far a job stands back: ingest and the live state go first."""


class JobFailed(Exception):
    """A task ended without a result; the message says why in one line, ``trace`` where it is a defect of ours."""

    def __init__(self, message: str, trace: str | None = None) -> None:
        """Keep both."""
        super().__init__(message)
        self.trace = trace


class JobCancelled(Exception):
    """A task was cancelled while it ran."""


class ExecutorLost(Exception):
    """What computes went away with the task, which is as it was: it may be started again."""


class Cancel:
    """A request to end a task, given from any thread."""

    def __init__(self) -> None:
        """Start without a request."""
        self._event = Event()

    def request(self) -> None:
        """Ask the task to end."""
        self._event.set()

    @property
    def requested(self) -> bool:
        """Whether the task shall end."""
        return self._event.is_set()


@dataclass(frozen=True)
class Task(Generic[T]):
    """``function(*args, progress=...)``, to be computed in another process.

    Attributes
    ----------
    function
        Found by its name over there; its arguments and what it returns travel.
    progress
        Called in a thread of this process.
    cancel
        Ends it from any thread.
    """

    function: Callable[..., T]
    args: tuple[Any, ...] = ()
    progress: Progress = no_progress
    cancel: Cancel = field(default_factory=Cancel)


class Tasks(ABC):
    """What computes tasks, here or elsewhere: a thread watches each, so many at a time."""

    def __init__(self, max_workers: int, deadline_s: float, threads: str) -> None:
        """Tasks that run longer than ``deadline_s`` are ended; ``threads`` is what the watching threads are called."""
        self._threads = ThreadPoolExecutor(max_workers, thread_name_prefix=threads)
        self._deadline_s = deadline_s
        self._closing = Cancel()

    def reach(self) -> None:
        """Return if there is something that computes, after waiting for it a while; ExecutorLost if there is nothing."""
        return

    def start(self, task: Task[T]) -> "Future[T]":
        """Queue a task; JobFailed, JobCancelled or ExecutorLost say how else than with its result it ended."""
        return self._threads.submit(self._supervise, task)

    def shutdown(self) -> None:
        """End every task."""
        self._closing.request()
        self._threads.shutdown(cancel_futures=True)

    def _raise_if_over(self, until_s: float, cancel: Cancel) -> None:
        """Raise what ends a task that is no longer wanted, or has taken too long."""
        if cancel.requested or self._closing.requested:
            raise JobCancelled
        if time.monotonic() > until_s:
            raise JobFailed(f"ended after {self._deadline_s:g} s, its deadline (TWIN_JOB_DEADLINE_S)")

    @abstractmethod
    def _supervise(self, task: Task[T]) -> T:
        """Have a task computed, and return what came of it."""


class ProcessPerTask(Tasks):
    """Runs each task in a fresh spawned process, at most ``max_workers`` at a time."""

    def __init__(self, max_workers: int, deadline_s: float, memory_MiB: float = math.inf) -> None:
        """Tasks that run longer than ``deadline_s`` or need more than ``memory_MiB`` are ended."""
        super().__init__(max_workers, deadline_s, "job")
        self._memory_MiB = memory_MiB

    def _supervise(self, task: Task[T]) -> T:
        name = f"{task.function.__module__}:{task.function.__qualname__}"
        ours, theirs = _CONTEXT.Pipe()
        process = _CONTEXT.Process(target=_run, args=(theirs, name, task.args), daemon=True)
        process.start()
        theirs.close()
        until_s = time.monotonic() + self._deadline_s
        try:
            while True:
                self._raise_if_over(until_s, task.cancel)
                if resident_MiB(process.pid or 0) > self._memory_MiB:
                    raise JobFailed(
                        f"ended: it needed more than {self._memory_MiB:g} MiB of memory (TWIN_JOB_MEMORY_MIB); "
                        "take fewer samples, or thin them"
                    )
                if not ours.poll(POLL_S):
                    continue
                kind, *rest = _receive(ours, process)
                if kind == "progress":
                    task.progress(*rest)
                elif kind == "failed":
                    raise JobFailed(*rest)
                else:
                    done: T = rest[0]
                    return done
        finally:
            _end(process)
            ours.close()


def resident_MiB(process: int) -> float:
    """Return the memory that a process and those forked from it have in use; 0 where nobody can tell.

    What they share counts once where the system tells it (proportional set size), else for each of them.
    """
    folder = Path("/proc", str(process))
    forked = [int(child) for thread in _threads(folder) for child in _text(thread / "children").split()]
    memory = _text(folder / "smaps_rollup") or _text(folder / "status")
    found = re.search(r"^(?:Pss|VmRSS):\s+(\d+) kB", memory, re.MULTILINE)
    return (int(found[1]) / 1024 if found else 0.0) + sum(map(resident_MiB, forked))


def _threads(folder: Path) -> list[Path]:
    """Return the folders of a process's threads; none where it has ended, which it may do while it is asked."""
    try:
        return list((folder / "task").iterdir())
    except OSError:
        return []


def _text(path: Path) -> str:
    """Return what a file holds; nothing where it is not there, or its process has ended."""
    try:
        return path.read_text()
    except OSError:
        return ""


_CONTEXT = multiprocessing.get_context("spawn")


def _receive(ours: Connection, process: Any) -> tuple[Any, ...]:
    try:
        message: tuple[Any, ...] = ours.recv()
    except (EOFError, OSError):
        process.join(END_GRACE_S)
        code = process.exitcode
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit status {code}"
        raise JobFailed(f"its worker process died ({how}); the service itself is well") from None
    return message


def _end(process: Any) -> None:
    process.join(0.0 if process.is_alive() else END_GRACE_S)
    if process.is_alive():
        process.terminate()
        process.join(END_GRACE_S)
    if process.is_alive():
        process.kill()
        process.join()
    process.close()


def prepare_worker() -> None:
    """Make a worker process live exactly as long as the service wants it to."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole process group; the parent decides
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as does the parent
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the service dies, however it dies: nobody would want the result."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)


def _run(connection: Connection, name: str, args: tuple[Any, ...]) -> None:
    """Do the task: the whole life of a worker process."""
    prepare_worker()
    keep_freed(APART_BYTES)
    os.nice(NICENESS)
    module, _, qualified = name.partition(":")
    function: Any = importlib.import_module(module)
    for part in qualified.split("."):
        function = getattr(function, part)

    def progress(fraction: float, message: str) -> None:
        give_back()
        connection.send(("progress", float(fraction), str(message)))

    answer: tuple[Any, ...]
    try:
        answer = ("done", function(*args, progress=progress))
    except TwinError as error:
        answer = ("failed", str(error))
    except MemoryError:
        answer = ("failed", "ran out of memory; use a shorter part of the archive")
    except Exception as error:
        answer = ("failed", f"{type(error).__name__}: {error}", traceback.format_exc())
    with contextlib.suppress(BrokenPipeError):  # the parent is gone; nobody wants the answer
        connection.send(answer)
