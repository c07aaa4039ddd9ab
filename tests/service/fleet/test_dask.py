"""Tasks on a Dask cluster whose worker, and then whose scheduler, is killed."""

import os
import socket
import time
from collections.abc import Callable
from pathlib import Path

import psycopg
import pytest

from service.jobs.dask import DaskTasks
from service.jobs.executor import Cancel, ExecutorLost, JobCancelled, JobFailed, Task
from tests.service.fakes import GATE
from tests.service.fleet.cluster import Cluster
from tests.service.fleet.load import LOGGED, WORKER, assert_jobs_done_once, calibrations, fleet, prepare
from tests.service.server import FAKE
from twin_core.errors import ModelError

pytestmark = [pytest.mark.fleet, pytest.mark.filterwarnings("ignore")]
Progress = Callable[[float, str], None]


def answer(value: float, heard: str, progress: Progress) -> float:
    """Return the double once somebody has heard that half is done."""
    progress(0.5, "half")
    end_s = time.monotonic() + 60.0
    while not Path(heard).exists() and time.monotonic() < end_s:
        time.sleep(0.05)
    return 2 * value


def refuse(progress: Progress) -> None:
    raise ModelError("the balance has no solution")


def dawdle(progress: Progress) -> int:
    time.sleep(8)
    return os.getpid()


def test_results_refusals_and_progress_come_back(cluster: Cluster, tmp_path: Path) -> None:
    tasks = DaskTasks(cluster.address, 2, 120.0)
    heard: list[str] = []

    def hear(fraction: float, message: str) -> None:
        heard.append(message)
        (tmp_path / "heard").touch()

    done = tasks.start(Task(answer, (21.0, str(tmp_path / "heard")), hear))
    assert done.result(120) == 42.0 and heard == ["half"]
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


def test_jobs_of_a_service_survive_worker_and_scheduler(
    tmp_path: Path, postgres: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The worker dies under a task, then the scheduler; jobs wait in the database and are done by what comes back."""
    gate = tmp_path / "gate"
    monkeypatch.setenv(GATE, str(gate))
    prepare(postgres, 1)
    cluster = Cluster()
    try:
        with fleet(tmp_path, [postgres], executor=cluster.address.replace("tcp://", "dask://")) as (service,):
            jobs = calibrations(service, 3)

            def wait_for(holds: Callable[[], bool]) -> None:
                end_s = time.monotonic() + 120.0
                while not holds():
                    assert time.monotonic() < end_s, service.log()
                    time.sleep(0.1)

            def computes() -> bool:
                with psycopg.connect(postgres, autocommit=True) as connection:
                    query = "SELECT 1 FROM job WHERE state = 'running' AND progress > 0.4"
                    return connection.execute(query).fetchone() is not None

            wait_for(computes)
            cluster.kill(cluster.worker)
            cluster.worker = cluster.add_worker()
            time.sleep(3)
            cluster.kill(cluster.scheduler)
            wait_for(lambda: "the job waits" in service.log())
            cluster.kill(cluster.worker)  # it would come back to the next scheduler by itself
            cluster.scheduler = cluster.add_scheduler()
            cluster.worker = cluster.add_worker()
            gate.touch()
            assert_jobs_done_once(postgres, jobs, "SIGKILL of a Dask worker, then of the Dask scheduler", 180.0)
    finally:
        cluster.kill(cluster.worker)
        cluster.kill(cluster.scheduler)


def test_a_scheduler_that_is_not_there_is_told_once_and_jobs_wait(
    tmp_path: Path, postgres: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = tmp_path / "gate"
    gate.touch()
    monkeypatch.setenv(GATE, str(gate))
    prepare(postgres, 1)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {"executor": f"dask://127.0.0.1:{port}", "log_level": "info", "job_workers": "0"}
    with fleet(tmp_path, [postgres] * 2, [FAKE, LOGGED + WORKER], **own) as (service, worker):
        jobs = calibrations(service, 2)

        def told(what: str) -> list[str]:
            return [line for line in worker.log().splitlines() if what in line]

        end_s = time.monotonic() + 60.0
        while not told("what computes is away"):
            assert time.monotonic() < end_s
            time.sleep(0.1)
        time.sleep(5)  # several looks later
        assert len(told("what computes is away")) == 1 and str(port) in told("what computes is away")[0]
        with psycopg.connect(postgres, autocommit=True) as connection:
            assert connection.execute("SELECT DISTINCT state FROM job").fetchall() == [("queued",)]
        cluster = Cluster(port)
        try:
            assert_jobs_done_once(postgres, jobs, "no Dask scheduler at first", 180.0)
            assert len(told("what computes is there again")) == 1
        finally:
            cluster.kill(cluster.worker)
            cluster.kill(cluster.scheduler)
