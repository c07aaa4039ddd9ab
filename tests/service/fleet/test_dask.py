"""Tasks on a Dask cluster whose worker, and then whose scheduler, is killed."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from service.jobs.dask import DaskTasks
from service.jobs.executor import Cancel, ExecutorLost, JobCancelled, JobFailed, Task
from twin_core.errors import ModelError

pytestmark = [pytest.mark.fleet, pytest.mark.filterwarnings("ignore")]
Progress = Callable[[float, str], None]


def answer(value: float, progress: Progress) -> float:
    progress(0.5, "half")
    time.sleep(0.5)
    return 2 * value


def refuse(progress: Progress) -> None:
    raise ModelError("the balance has no solution")


def dawdle(progress: Progress) -> int:
    time.sleep(8)
    return os.getpid()


class Cluster:
    """A scheduler and a worker, each a process that a test may kill."""

    def __init__(self) -> None:
        """Start both."""
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        self.scheduler = self._start("dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
        self.worker = self.add_worker()

    def add_worker(self) -> "subprocess.Popen[bytes]":
        """Start another worker."""
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")
        return self._start("dask_worker", self.address, *options)

    @staticmethod
    def _start(name: str, *arguments: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", f"distributed.cli.{name}", *arguments]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)

    @staticmethod
    def kill(process: "subprocess.Popen[bytes]") -> None:
        """End a process as a crash would."""
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    made = Cluster()
    yield made
    made.kill(made.worker)
    made.kill(made.scheduler)


def test_results_refusals_and_progress_come_back(cluster: Cluster) -> None:
    tasks = DaskTasks(cluster.address, 2, 60.0)
    heard: list[str] = []
    done = tasks.start(Task(answer, (21.0,), lambda fraction, message: heard.append(message)))
    assert done.result(60) == 42.0 and heard == ["half"]
    with pytest.raises(JobFailed, match="no solution"):
        tasks.start(Task(refuse)).result(60)
    cancel = Cancel()
    late = tasks.start(Task(dawdle, cancel=cancel))
    cancel.request()
    with pytest.raises(JobCancelled):
        late.result(30)
    tasks.shutdown()


def test_a_task_survives_its_worker_and_is_given_back_with_its_scheduler(cluster: Cluster) -> None:
    tasks = DaskTasks(cluster.address, 2, 120.0)
    slow = tasks.start(Task(dawdle))
    time.sleep(5)
    first = cluster.worker
    cluster.worker = cluster.add_worker()
    cluster.kill(first)
    assert slow.result(90) != first.pid
    lost = tasks.start(Task(dawdle))
    time.sleep(3)
    cluster.kill(cluster.scheduler)
    with pytest.raises(ExecutorLost):
        lost.result(90)
    tasks.shutdown()
