"""Tasks on a Dask cluster. What is true stands in the database: a cluster that goes away loses nothing but time."""

import socket
import threading
import time
import uuid
from collections.abc import Callable
from typing import Any, TypeVar

from distributed import Client, get_worker

from service.jobs.executor import ExecutorLost, JobFailed, Task, Tasks
from twin_core.errors import TwinError

T = TypeVar("T")

POLL_S = 0.2
AWAY_S = 15.0
"""A scheduler that has been away for so long is given up; its tasks are put back."""
CONNECT_S = 10.0


class DaskTasks(Tasks):
    """Runs ``function(*args, progress=...)`` on the workers of a Dask scheduler, at most so many at a time."""

    def __init__(self, address: str, max_workers: int, deadline_s: float) -> None:
        """Connect with the first task; one that runs longer than ``deadline_s`` is ended."""
        super().__init__(max_workers, deadline_s, "dask")
        self._address = address
        self._lock = threading.Lock()
        self._client: Client | None = None

    def reach(self) -> None:
        """Return if the scheduler answers; ExecutorLost if it does not, or is no scheduler."""
        if self._connected().status != "running":
            raise ExecutorLost(f"no scheduler answers at {self._address}")

    def shutdown(self) -> None:
        """End every task and let go of the cluster."""
        super().shutdown()
        with self._lock:
            if self._client is not None:
                self._client.close(timeout=2)

    def _connected(self) -> Client:
        with self._lock:
            if self._client is None or self._client.status not in ("running", "connecting"):
                try:
                    self._knock()
                    self._client = Client(self._address, timeout=CONNECT_S, set_as_default=False)
                except (OSError, ValueError) as error:
                    raise ExecutorLost(f"no scheduler answers at {self._address}") from error
            return self._client

    def _knock(self) -> None:
        """Wait until somebody listens: a client of Dask that finds nobody leaves a thread behind, for which the exit waits."""
        host, _, port = self._address.partition("://")[2].rpartition(":")
        until_s = time.monotonic() + CONNECT_S
        while True:
            try:
                socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
                return
            except OSError:
                if time.monotonic() > until_s or self._closing.requested:
                    raise
            time.sleep(POLL_S)

    def _supervise(self, task: Task[T]) -> T:
        client = self._connected()
        topic = f"twin-{uuid.uuid4().hex}"
        client.subscribe_topic(topic, lambda event: task.progress(*event[1]))  # before anything can be said
        future = client.get_executor(pure=False, retries=2).submit(_run, topic, task.function, task.args)
        until_s = time.monotonic() + self._deadline_s
        seen_s = time.monotonic()
        try:
            while not future.done():
                self._raise_if_over(until_s, task.cancel)
                if client.status == "running":
                    seen_s = time.monotonic()
                elif time.monotonic() - seen_s > AWAY_S:
                    raise ExecutorLost(f"the scheduler at {self._address} went away")
                time.sleep(POLL_S)
            if future.cancelled():
                raise ExecutorLost(f"the scheduler at {self._address} forgot a task")
            kind, *rest = future.result()
        except (OSError, RuntimeError) as error:
            raise ExecutorLost(f"{type(error).__name__}: {error}") from error
        finally:
            future.cancel()
            if client.status == "running":
                client.unsubscribe_topic(topic)
        if kind == "failed":
            raise JobFailed(*rest)
        done: T = rest[0]
        return done


def _run(topic: str, function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, ...]:
    """Do the task in a worker of the cluster; what went wrong comes back as a value, so that it is not tried again."""
    worker = get_worker()

    def progress(fraction: float, message: str) -> None:
        worker.log_event(topic, (float(fraction), str(message)))

    try:
        return ("done", function(*args, progress=progress))
    except TwinError as error:
        return ("failed", str(error))
    except Exception as error:
        return ("failed", f"{type(error).__name__}: {error}")
