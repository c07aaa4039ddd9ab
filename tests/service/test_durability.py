"""What was acknowledged survives: kills in the middle of ingest and of jobs, restarts, a full disk, a second server."""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from service.client import ApiError, TwinClient, Unreachable
from service.settings import read_settings
from service.store.database import Database
from service.store.errors import StoreError
from tests.service.conftest import SPEC
from tests.service.server import FAKE, Server

pytestmark = pytest.mark.e2e


class Sender(threading.Thread):
    """Sends samples of its own, one small batch after another, and remembers what was acknowledged."""

    def __init__(self, client: TwinClient, lane: int) -> None:
        super().__init__()
        self._client, self._lane = client, lane
        self.acknowledged: list[float] = []

    def run(self) -> None:
        with contextlib.suppress(Unreachable):
            for number in range(100_000):
                times = [float(self._lane * 10**7 + 3 * number + k) for k in range(3)]
                report = self._client.ingest("benchsat", times, {"Q_px": times})
                assert report.accepted == 3
                self.acknowledged += times


def test_acknowledged_samples_survive_a_kill_exactly_once(tmp_path: Path) -> None:
    with Server(tmp_path) as server:
        server.client().register(SPEC)
        acknowledged: set[float] = set()
        for attempt in range(3):
            senders = [Sender(server.client(), lane) for lane in range(4 * attempt, 4 * attempt + 4)]
            for sender in senders:
                sender.start()
            while sum(len(sender.acknowledged) for sender in senders) < 300:
                assert all(sender.is_alive() for sender in senders)
                time.sleep(0.01)
            server.kill()
            for sender in senders:
                sender.join()
                acknowledged |= set(sender.acknowledged)
            server.start()
            client = server.client()
            archive = client.archive("benchsat")
            stored = archive.values["Q_px"]
            assert len(set(stored)) == len(stored) == archive.samples
            assert acknowledged <= set(stored)
            assert len(stored) - len(acknowledged) <= 3 * 4 * (
                attempt + 1
            )  # at most one batch per sender was under way
            assert client.twin("benchsat").samples == archive.samples
            assert client.twin("benchsat").seq >= archive.samples


def test_a_job_interrupted_by_a_kill_is_marked_failed_and_leaves_no_process(tmp_path: Path) -> None:
    with Server(tmp_path) as server:
        client = server.client()
        client.register(SPEC)
        n = 20_000
        read = {"T_px": [290 + k % 7 for k in range(n)], "T_tank": [20 + k % 11 for k in range(n)], "Q_px": [1.0] * n}
        client.ingest("benchsat", [60.0 * k for k in range(n)], read)
        job = client.calibrate("benchsat", samples=n)
        while job.state != "running":
            job = client.job("benchsat", job)
        time.sleep(0.5)
        server.kill()
        _wait_until_group_is_gone(server.process.pid)
        server.start()
        job = server.client().job("benchsat", job)
        assert job.state == "failed"
        assert "interrupted" in job.message


class Switcher(threading.Thread):
    """Activates one version after the other and remembers the last one that was confirmed."""

    def __init__(self, client: TwinClient) -> None:
        super().__init__()
        self._client = client
        self.confirmed = 0
        self.count = 0

    def run(self) -> None:
        with contextlib.suppress(Unreachable):
            while True:
                version = 1 + self.count % 2
                self._client.activate("benchsat", version)
                self.confirmed, self.count = version, self.count + 1


def test_a_kill_during_activation_leaves_one_whole_model_active(tmp_path: Path) -> None:
    with Server(tmp_path, command=FAKE) as server:
        client = server.client()
        client.register(SPEC)
        client.ingest("benchsat", [60.0 * k for k in range(50)], {"T_px": [290.0 + k % 7 for k in range(50)]})
        for _ in range(2):
            client._http.post("/v1/twins/benchsat/models", json={"spec": SPEC, "rmse_K": 1.0, "max_step_s": 60.0})
        for attempt in range(2):
            switcher = Switcher(server.client())
            switcher.start()
            while switcher.count < 5 + attempt:
                assert switcher.is_alive()
                time.sleep(0.002)
            server.kill()
            switcher.join()
            server.start()
            client = server.client()
            active = [model.version for model in client.models("benchsat") if model.active]
            # The last confirmed switch stands, or the one under way, and everybody agrees on it.
            assert active in ([switcher.confirmed], [3 - switcher.confirmed])
            assert client.twin("benchsat").active_model == active[0]
            log = client._http.get("/v1/twins/benchsat/models").json()["activations"]
            assert log[0]["version"] == active[0]
            assert set(client.all_residuals("benchsat").model_version) == {active[0]}


def test_a_worker_that_is_killed_is_replaced(tmp_path: Path) -> None:
    with Server(tmp_path, command=FAKE) as server:
        client = server.client()
        client.register(SPEC)
        rows = range(200)
        client.ingest(
            "benchsat", [60.0 * k for k in rows], {"T_px": [290.0 + k % 7 for k in rows], "Q_px": [0.5] * 200}
        )
        assert client.wait("benchsat", client.calibrate("benchsat")).state == "succeeded"
        assert len(client.all_residuals("benchsat").time) == 200
        for worker in _children(server.process.pid):
            os.kill(worker, signal.SIGKILL)
        client.ingest("benchsat", [60.0 * 200], {"T_px": [291.0]})
        assert len(client.all_residuals("benchsat").time) == 201
        assert client.forecast("benchsat", 600.0, step_s=60.0).model_version == 1
        assert "another one takes over" in server.log()


def _children(process: int) -> list[int]:
    """Return the worker processes of a server: those that have started Python anew."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                status = (entry / "stat").read_text().rsplit(")", 1)[1].split()
                if int(status[1]) == process and b"spawn_main" in (entry / "cmdline").read_bytes():
                    found.append(int(entry.name))
    assert found
    return found


def _wait_until_group_is_gone(group: int) -> None:
    for _ in range(1200):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    os.killpg(group, signal.SIGKILL)
    raise AssertionError("worker processes outlived the service")


@pytest.mark.parametrize("link", [None, "symlink_to", "hardlink_to"])
def test_second_server_on_one_database_is_refused(tmp_path: Path, link: str | None) -> None:
    with Server(tmp_path) as server:
        path = tmp_path / "twin.sqlite3"
        if link is not None:
            (tmp_path / "elsewhere").mkdir()
            other = tmp_path / "elsewhere" / "other.sqlite3"
            getattr(other, link)(path)
            path = other
        environment = {**os.environ, "TWIN_PORT": "0", "TWIN_DATABASE_URL": f"sqlite:///{path}"}
        second = subprocess.run(
            [sys.executable, "-m", "service"], env=environment, capture_output=True, text=True, timeout=120, check=False
        )
        assert second.returncode == 2
        assert "another server uses this database" in second.stderr
        assert "Traceback" not in second.stderr
        assert server.client().is_ready()


def test_a_second_store_in_one_process_is_refused_under_any_name(tmp_path: Path) -> None:
    path, other = tmp_path / "twin.sqlite3", tmp_path / "other.sqlite3"
    first = Database(path)
    other.hardlink_to(path)
    for name in (path, other):
        with pytest.raises(StoreError, match="another server"):
            Database(name)
    first.close()
    Database(path).close()


def test_graceful_stop_finishes_what_it_acknowledged(tmp_path: Path) -> None:
    with Server(tmp_path) as server:
        client = server.client()
        client.register(SPEC)
        client.ingest("benchsat", [1.0, 2.0], {"T_px": [1.0, 2.0]})
        assert server.stop() in (0, -signal.SIGTERM)
        server.start()
        assert server.client().archive("benchsat").values["T_px"] == [1.0, 2.0]


@pytest.mark.parametrize("content", [b"not a database at all, but longer than a header" * 40, None])
def test_what_cannot_be_a_database_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "twin.sqlite3"
    if content is None:
        path = tmp_path / "no" / "such" / "folder.sqlite3"
    else:
        path.write_bytes(content)
    with pytest.raises(StoreError, match="TWIN_DATABASE_URL"):
        Database(read_settings(database_url=f"sqlite:///{path}").database_path)


def test_full_disk_is_507_and_recovers(tmp_path: Path) -> None:
    """A file-size limit stands in for the disk: SQLite sees the same short writes."""
    script = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, resource.RLIM_INFINITY));"
        "from service.__main__ import main; sys.exit(main())"
    )
    with Server(tmp_path, command=script) as server:
        client = server.client()
        client.register(SPEC)
        stored, refusal = 0, None
        while refusal is None:
            times = [float(stored + k) for k in range(1000)]
            try:
                stored += client.ingest("benchsat", times, {"Q_px": times}).accepted
            except ApiError as error:
                refusal = error
        assert refusal.status == 507
        assert client.twin("benchsat").samples == stored
        assert client.archive("benchsat").samples == stored
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        assert client.ingest("benchsat", times, {"Q_px": times}).accepted == 1000  # by itself, once there is room
    with Server(tmp_path) as server:
        assert server.client().archive("benchsat").samples == stored + 1000
