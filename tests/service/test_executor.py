"""Worker processes: they stand back behind the service."""

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from service.jobs import executor as executor_module
from service.jobs.executor import NICENESS, JobFailed, ProcessPerTask, Task, resident_MiB
from tests.service.conftest import SPEC
from tests.service.server import FAKE, Server
from twin_core import side_by_side


def niceness(*, progress: Callable[[float, str], None]) -> int:
    """Return the niceness that a task finds."""
    return os.nice(0)


def test_a_job_has_a_low_priority() -> None:
    executor = ProcessPerTask(1, 280.0)  # it may wait long for a processor: that is what low means
    assert executor.start(Task(niceness)).result() == min(os.nice(0) + NICENESS, 19)
    executor.shutdown()


def hoard(path: str) -> float:
    """Hold 500 MiB until the task is ended."""
    held = np.ones(500 * 2**17)
    Path(path).touch()
    time.sleep(600.0)
    return float(held[0])


def hoarding(folder: str, *, progress: Callable[[float, str], None]) -> list[float]:
    """Hold 1000 MiB in two forked processes."""
    side_by_side.n_cores = lambda: 2
    return side_by_side.side_by_side([partial(hoard, f"{folder}/{i}") for i in range(2)])


@pytest.mark.parametrize("told", [("smaps_rollup", "status"), ("status",)])
def test_the_memory_of_a_process_is_known_on_any_linux(monkeypatch: pytest.MonkeyPatch, told: tuple[str, ...]) -> None:
    """Sandboxes and old kernels have no proportional sizes."""
    whole = executor_module._text
    monkeypatch.setattr(executor_module, "_text", lambda path: whole(path) if path.name in told else "")
    held = np.ones(50 * 2**17)
    assert resident_MiB(os.getpid()) > held.nbytes / 2**20
    assert resident_MiB(2**22 + 1) == 0.0  # nobody's number


def test_a_process_may_end_while_its_memory_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that was forked from a job ended between two looks at its folder, and took the job with it."""

    def gone(told: Callable[..., Any]) -> Callable[..., Any]:
        def look(path: Any) -> Any:
            if os.fspath(path).endswith("/task"):
                raise FileNotFoundError(2, "No such file or directory", os.fspath(path))
            return told(path)

        return look

    for name in ("scandir", "listdir"):
        monkeypatch.setattr(os, name, gone(getattr(os, name)))
    assert resident_MiB(os.getpid()) > 0.0


@pytest.mark.skipif(not side_by_side.CAN_FORK, reason="this system does not fork safely")
def test_the_memory_of_forked_processes_counts(tmp_path: Path) -> None:
    """Each of them alone stays below the limit."""
    executor = ProcessPerTask(1, 280.0, memory_MiB=900.0)
    with pytest.raises(JobFailed, match="needed more than 900 MiB"):
        executor.start(Task(hoarding, (str(tmp_path),))).result()
    executor.shutdown()


@pytest.mark.e2e
@pytest.mark.parametrize(("setting", "threads"), [(None, b"1"), ("2", b"2")])
def test_a_worker_computes_in_one_thread_unless_told_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, setting: str | None, threads: bytes
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if setting is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", setting)
    with Server(tmp_path, FAKE) as server, server.client() as client:
        client.register(SPEC)
        model = {"spec": SPEC, "rmse_K": 1.0, "max_step_s": 60.0}
        assert httpx.post(f"{server.url}/v1/twins/benchsat/models", json=model, timeout=60).status_code == 201
        workers = Path(f"/proc/{server.process.pid}/task/{server.process.pid}/children").read_text().split()
        settings = [Path(f"/proc/{worker}/environ").read_bytes().split(b"\0") for worker in workers]
    assert settings and all(b"OMP_NUM_THREADS=" + threads in setting for setting in settings)
