"""Faults under load: no acknowledged sample is lost, none is there twice, no twin is followed by two, no job is lost."""

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import psycopg
import pytest

from tests.service.fleet.load import SKEWED, Load, assert_nothing_lost, fleet, prepare
from tests.service.postgres import Postgres, own_server
from tests.service.server import FAKE

pytestmark = pytest.mark.fleet
TWINS = 8


def test_a_loss_would_be_noticed(tmp_path: Path, postgres: str) -> None:
    prepare(postgres, 2)
    with fleet(tmp_path, [postgres]) as (service,):
        load = Load(lambda: [service.url], 2)
        time.sleep(2)
        load.end()
        assert_nothing_lost(postgres, load)
    load.sent["sat-1"] += 3  # as if they had been acknowledged
    with pytest.raises(AssertionError):
        assert_nothing_lost(postgres, load)
    load.sent["sat-1"] -= 3
    with psycopg.connect(postgres) as connection:
        connection.execute("DELETE FROM residual WHERE twin = 2")
    with pytest.raises(AssertionError, match="sat-1: 0 of"):
        assert_nothing_lost(postgres, load, wait_s=0.0)


def test_an_owner_is_killed(tmp_path: Path, postgres: str) -> None:
    prepare(postgres, TWINS)
    with fleet(tmp_path, [postgres] * 2) as (one, other):
        alive = [one.url, other.url]
        load = Load(lambda: list(alive), TWINS)
        time.sleep(6)
        one.kill()
        alive.remove(one.url)
        before = load.acknowledged
        time.sleep(10)
        load.end()
        assert load.acknowledged > before > 0, "the other one took nothing"
        assert_nothing_lost(postgres, load)


def test_the_database_is_killed(tmp_path: Path) -> None:
    with own_server("fsync=on") as server:
        prepare(server.url, TWINS)
        with fleet(tmp_path, [server.url] * 2) as services:
            load = Load(lambda: [s.url for s in services], TWINS)
            time.sleep(4)
            before = load.acknowledged
            server.kill()
            load.until(lambda: load.refused > 0)  # the outage is noticed, however slow the machine is
            server.start()
            during = load.acknowledged
            load.until(lambda: load.acknowledged > during)
            time.sleep(5)
            load.end()
            assert load.refused > 0 and load.acknowledged > during >= before > 0
            assert_nothing_lost(server.url, load)


class Cut:
    """A way to the database that can be cut: packets vanish, connections stay."""

    def __init__(self, port: int) -> None:
        """Lead to a port of this machine."""
        self._goal, self.is_cut = port, threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Let nobody in any more."""
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                caller, _ = self._listener.accept()
                goal = socket.create_connection(("127.0.0.1", self._goal))
                for ends in ((caller, goal), (goal, caller)):
                    threading.Thread(target=self._pass, args=ends, daemon=True).start()

    def _pass(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while piece := source.recv(65536):
                while self.is_cut.is_set():
                    time.sleep(0.05)
                target.sendall(piece)
        source.close()
        target.close()


def test_the_network_is_cut(tmp_path: Path, postgres: str) -> None:
    parts = urlsplit(postgres)
    assert parts.port is not None
    way = Cut(parts.port)
    prepare(postgres, TWINS)
    with fleet(tmp_path, [postgres.replace(f":{parts.port}/", f":{way.port}/"), postgres]) as (cut, other):
        alive = [cut.url, other.url]
        load = Load(lambda: list(alive), TWINS)
        time.sleep(5)
        way.is_cut.set()
        alive.remove(cut.url)
        time.sleep(12)  # the other one takes over
        way.is_cut.clear()  # what was under way arrives now, from somebody whose leases have lapsed
        alive.append(cut.url)
        time.sleep(6)
        load.end()
        assert_nothing_lost(postgres, load)
        with psycopg.connect(postgres) as connection:
            owners = connection.execute("SELECT count(DISTINCT owner) FROM slot WHERE until_us > clock_us()").fetchone()
            assert owners == (2,)
    way.close()


def test_clocks_differ_by_minutes(tmp_path: Path, postgres: str) -> None:
    prepare(postgres, TWINS)
    with fleet(tmp_path, [postgres] * 2, [SKEWED.format(skew_s=-300), SKEWED.format(skew_s=420)]) as (one, other):
        alive = [one.url, other.url]
        load = Load(lambda: list(alive), TWINS)
        time.sleep(6)
        one.kill()
        alive.remove(one.url)
        before = load.acknowledged
        time.sleep(10)
        load.end()
        assert load.acknowledged > before > 0, "the other one took nothing"
        assert_nothing_lost(postgres, load)


def test_failover_to_a_promoted_standby(tmp_path: Path) -> None:
    with own_server("fsync=on", "max_wal_senders=4") as primary:
        place = Path(tempfile.mkdtemp(prefix="twin-standby-", dir="/tmp"))
        place.chmod(0o755)
        folder = place / "server"
        folder.mkdir()
        standby = Postgres(folder)
        if os.geteuid() == 0:
            shutil.chown(folder, 65534, 65534)
        try:
            source = f"host=127.0.0.1 port={primary.port} user=twin application_name=standby"
            standby.run("pg_basebackup", "-d", source, "-D", str(standby.data), "-R", "-X", "stream")
            standby.start()
            with psycopg.connect(primary.url, autocommit=True) as connection:
                connection.execute("ALTER SYSTEM SET synchronous_standby_names = '*'")
                connection.execute("SELECT pg_reload_conf()")
            hosts = f"127.0.0.1:{primary.port},127.0.0.1:{standby.port}"
            url = f"postgresql://twin@{hosts}/postgres?target_session_attrs=read-write"
            prepare(url, TWINS)
            with fleet(tmp_path, [url] * 2) as services:
                load = Load(lambda: [s.url for s in services], TWINS)
                time.sleep(4)
                primary.kill()
                with psycopg.connect(standby.url, autocommit=True) as connection:
                    connection.execute("ALTER SYSTEM SET synchronous_standby_names = ''")
                    connection.execute("SELECT pg_promote()")
                time.sleep(12)
                load.end()
                assert load.refused > 0
                assert_nothing_lost(url, load)
        finally:
            standby.kill()
            shutil.rmtree(place, ignore_errors=True)


@pytest.fixture
def small_disk() -> Iterator[Path]:
    """A folder with room for a few megabytes."""
    folder = Path(tempfile.mkdtemp(prefix="twin-small-", dir="/tmp"))
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=6m,mode=0777", "tmpfs", str(folder)], capture_output=True
    )
    if mounted.returncode != 0:
        pytest.skip("a small disk cannot be mounted here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)
    folder.rmdir()


def test_the_disk_is_full(tmp_path: Path, postgres_url: str, small_disk: Path) -> None:
    place = small_disk / "space"
    place.mkdir()
    if os.geteuid() == 0:
        os.chown(place, 65534, 65534)
    name = f"small_{os.getpid()}"
    with psycopg.connect(postgres_url, autocommit=True) as connection:
        connection.execute(f"CREATE TABLESPACE {name} LOCATION '{place}'")  # type: ignore[call-overload]
        connection.execute(f"CREATE SCHEMA {name}")  # type: ignore[call-overload]
        url = f"{postgres_url}?options=-c%20search_path%3D{name}%20-c%20default_tablespace%3D{name}"
        try:
            prepare(url, TWINS)
            ballast = small_disk / "ballast"
            with fleet(tmp_path, [url]) as (service,):
                load = Load(lambda: [service.url], TWINS)
                time.sleep(3)
                with contextlib.suppress(OSError), ballast.open("wb") as file:
                    while True:
                        file.write(b"0" * 4096)
                        file.flush()
                end_s = time.monotonic() + 60
                while load.refused == 0 and time.monotonic() < end_s:
                    time.sleep(0.1)
                assert load.refused > 0
                ballast.unlink()
                time.sleep(3)
                load.end()
                assert_nothing_lost(url, load)
        finally:
            connection.execute(f"DROP SCHEMA {name} CASCADE")  # type: ignore[call-overload]
            connection.execute(f"DROP TABLESPACE {name}")  # type: ignore[call-overload]


def test_a_worker_is_killed(tmp_path: Path, postgres: str) -> None:
    prepare(postgres, 1)
    worker = FAKE.replace("service.server import serve", "service.worker import work").replace(
        "serve(read_settings(), lambda url: print('listening on', url, flush=True), FakeWorkbench)",
        "work(read_settings(), lambda: print('listening on', 'nothing', flush=True), FakeWorkbench)",
    )
    with fleet(tmp_path, [postgres] * 3, [FAKE, worker, worker]) as (service, *workers):
        twin = f"{service.url}/v1/twins/sat-0"
        values = {"T_px": [290.0] * 60, "T_tank": [10.0] * 60, "Q_px": [16.0] * 60}  # a calibration that never ends
        assert (
            httpx.post(f"{twin}/telemetry", json={"time": list(range(60)), "values": values}).json()["accepted"] == 60
        )
        paths = [httpx.post(f"{twin}/calibrations", json={}).headers["location"] for _ in range(3)]

        def held() -> dict[str, tuple[str, int]]:
            with psycopg.connect(postgres) as connection:
                rows = connection.execute("SELECT id, worker, attempt FROM job WHERE state = 'running'").fetchall()
            return {job: (name, attempt) for job, name, attempt in rows}

        while len(first := held()) < 3:  # the service itself does one, each worker another one
            time.sleep(0.1)
        victim = next(job for job, (name, _) in first.items() if f":{workers[0].process.pid}:" in name)
        workers[0].kill()
        others = [path.rsplit("/", 1)[1] for path in paths if not path.endswith(victim)]
        httpx.delete(f"{service.url}/v1/twins/sat-0/calibrations/{others[0]}", timeout=60)  # room for it
        end_s = time.monotonic() + 90
        while (now := held().get(victim)) is None or now[1] < 2:
            assert time.monotonic() < end_s
            time.sleep(0.2)
        assert now[0] != first[victim][0]
        for job in (victim, others[1]):
            answer = httpx.delete(f"{service.url}/v1/twins/sat-0/calibrations/{job}", timeout=60).json()
            assert answer["state"] == "cancelled"
