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

import psycopg
import pytest

from service.settings import Settings
from tests.service.fakes import GATE
from tests.service.fleet.load import (
    KEY,
    SKEWED,
    WORKER,
    Load,
    assert_jobs_done_once,
    assert_nothing_lost,
    calibrations,
    fleet,
    prepare,
    tally,
)
from tests.service.postgres import Postgres, own_server
from tests.service.server import FAKE, Server

pytestmark = pytest.mark.fleet
TWINS = 8
LATE_S, PAST_S = 420, 200
"""A clock that shows the present so much later, and the past that a load begins with: LATE_S - TOLERANCE_S < PAST_S."""
TOLERANCE_S = Settings.model_fields["clock_tolerance_s"].default
"""The default: samples further ahead of the clock go into quarantine."""


def test_a_loss_would_be_noticed(tmp_path: Path, postgres: str) -> None:
    prepare(postgres, 2)
    with fleet(tmp_path, [postgres]) as (service,):
        load = Load(lambda: [service.url], 2)
        load.until(lambda: min(load.sent.values()) >= 6)
        load.end()
        assert_nothing_lost(postgres, load, "none")
    n = load.sent["sat-1"]
    load.sent["sat-1"] += 3  # as if they had been acknowledged
    assert tally(postgres, load, 0.0).lost >= 1  # the last two may be stored
    load.sent["sat-1"] -= 3
    with psycopg.connect(postgres, autocommit=True) as connection:
        copied = "twin, n, first_us, last_us, last_seq, seq, time, value, received"
        connection.execute(f"INSERT INTO chunk ({copied}) SELECT {copied} FROM chunk WHERE twin = 1 LIMIT 1")
        assert tally(postgres, load, 0.0).twice >= 4  # two samples, and their numbers
        query = "SELECT 1, last_seq, 0, 'job', '{}' FROM chunk WHERE twin = 1 LIMIT 1"
        connection.execute(f"INSERT INTO event (twin, seq, time_us, type, body) {query}")
        assert tally(postgres, load, 0.0).twice >= 5  # a number of a sample that a message has, too
        connection.execute("DELETE FROM residual WHERE twin = 2")
        connection.execute("UPDATE tenure SET from_us = 0 WHERE epoch = 1")
        connection.execute("INSERT INTO tenure SELECT slot, epoch + 1, 'another', -1 FROM tenure WHERE slot = 5")
        connection.execute("INSERT INTO written (twin, epoch, writer) VALUES (1, 99, 'a'), (1, 99, 'b'), (1, 99, 'a')")
        found = tally(postgres, load, 0.0)
    assert found.wrong >= n and found.owned_twice == 2
    with pytest.raises(AssertionError):
        found.assert_nothing_lost()


def test_an_owner_is_killed(tmp_path: Path, postgres: str) -> None:
    prepare(postgres, TWINS)
    with fleet(tmp_path, [postgres] * 2) as (one, other):
        alive = [one.url, other.url]
        load = Load(lambda: list(alive), TWINS)
        load.until(lambda: load.acknowledged > 4 * TWINS)
        time.sleep(4)
        one.kill()
        alive.remove(one.url)
        before = load.acknowledged
        time.sleep(10)
        load.until(lambda: load.acknowledged > before + TWINS)  # by the other one
        load.end()
        assert_nothing_lost(postgres, load, "SIGKILL of an owner")


def test_the_database_is_killed(tmp_path: Path) -> None:
    with own_server("fsync=on") as server:
        prepare(server.url, TWINS)
        with fleet(tmp_path, [server.url] * 2) as services:
            load = Load(lambda: [s.url for s in services], TWINS)
            load.until(lambda: load.acknowledged > 4 * TWINS)
            time.sleep(2)
            before = load.acknowledged
            server.kill()
            load.until(lambda: load.refused > 0)  # the outage is noticed, however slow the machine is
            server.start()
            during = load.acknowledged
            load.until(lambda: load.acknowledged > during)
            time.sleep(5)
            load.end()
            assert load.refused > 0 and load.acknowledged > during >= before
            assert_nothing_lost(server.url, load, "SIGKILL of the database")


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
        for end in (source, target):  # closing alone tells nobody while the other thread waits for something to arrive
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()


class Network:
    """A network of its own: one line leads to the database, another one to clients. Both begin on this machine."""

    DATABASE, CLIENTS = "10.231.7.1", "10.231.7.5"

    def __init__(self) -> None:
        """Lay the lines; skips the test where that is not allowed."""
        self.name = f"twin{os.getpid()}"
        self.within = ("ip", "netns", "exec", self.name)
        self._lines = (f"tdb{os.getpid()}", f"tcl{os.getpid()}")
        if (
            shutil.which("ip") is None
            or subprocess.run(["ip", "netns", "add", self.name], capture_output=True).returncode
        ):
            pytest.skip("no network namespaces here")
        for line, inner, (ours, theirs) in zip(
            self._lines, ("db", "cl"), ((self.DATABASE, "10.231.7.2"), (self.CLIENTS, "10.231.7.6")), strict=True
        ):
            _ip("link", "add", line, "type", "veth", "peer", "name", inner, "netns", self.name)
            _ip("addr", "add", f"{ours}/30", "dev", line)
            _ip("link", "set", line, "up")
            _ip("-n", self.name, "addr", "add", f"{theirs}/30", "dev", inner)
            _ip("-n", self.name, "link", "set", inner, "up")
        _ip("-n", self.name, "link", "set", "lo", "up")

    def set(self, state: str) -> None:
        """Cut the line to the database (down), or mend it (up)."""
        _ip("link", "set", self._lines[0], state)

    def close(self) -> None:
        """Take everything away."""
        for line in self._lines:
            subprocess.run(["ip", "link", "delete", line], capture_output=True)
        subprocess.run(["ip", "netns", "delete", self.name], capture_output=True)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def test_a_service_loses_its_network(tmp_path: Path) -> None:
    """Packets between one service and the database vanish in the kernel; clients reach both services all the while."""
    with contextlib.closing(Network()) as network, own_server("fsync=on", "listen_addresses=*") as server:
        server.trust("10.231.7.0/24")
        prepare(server.url, TWINS)
        far = server.url.replace("127.0.0.1", network.DATABASE)
        for place in ("far", "near"):
            (tmp_path / place).mkdir()
        quiet = {"log_level": "warning", "clock_tolerance_s": "0"}
        keys = {"host": "10.231.7.6", "api_keys": f"operate:{KEY}"}
        with (
            Server(tmp_path / "far", FAKE, network.within, database_url=far, **keys, **quiet) as cut,
            Server(tmp_path / "near", FAKE, database_url=server.url, **quiet) as other,
        ):
            load = Load(lambda: [cut.url, other.url], TWINS)
            load.until(lambda: load.acknowledged > 4 * TWINS)
            network.set("down")
            load.until(lambda: load.refused > 0)
            during = load.acknowledged
            time.sleep(12)  # longer than leases last, and than the kernel waits for an answer
            assert load.acknowledged > during, "the other one took nothing"
            network.set("up")
            with psycopg.connect(server.url, autocommit=True) as connection:
                query = "SELECT count(DISTINCT owner) FROM slot WHERE until_us > clock_us()"
                load.until(lambda: connection.execute(query).fetchone() == (2,))  # it has come back
            time.sleep(4)
            load.end()
            assert_nothing_lost(server.url, load, "network between service and database cut (namespaces)")


def test_the_network_is_cut(tmp_path: Path, postgres: str) -> None:
    parts = urlsplit(postgres)
    assert parts.port is not None
    way = Cut(parts.port)
    prepare(postgres, TWINS)
    with fleet(tmp_path, [postgres.replace(f":{parts.port}/", f":{way.port}/"), postgres]) as (cut, other):
        alive = [cut.url, other.url]
        load = Load(lambda: list(alive), TWINS)
        with psycopg.connect(postgres, autocommit=True) as connection:

            def owners() -> int:
                query = "SELECT count(DISTINCT owner) FROM slot WHERE until_us > clock_us()"
                return int(connection.execute(query).fetchone()[0])  # type: ignore[index]

            load.until(lambda: owners() == 2 and load.acknowledged > 4 * TWINS)
            way.is_cut.set()
            alive.remove(cut.url)
            load.until(lambda: owners() == 1)
            time.sleep(4)  # the other one goes on with what it has taken over
            way.is_cut.clear()  # what was under way arrives now, from somebody whose leases have lapsed
            alive.append(cut.url)
            load.until(lambda: owners() == 2)
            time.sleep(4)
        load.end()
        assert_nothing_lost(postgres, load, "path to the database cut, sent late")
    way.close()


def test_clocks_differ_by_minutes(tmp_path: Path, postgres: str) -> None:
    """Quarantine is on: samples of the present lie further ahead of the clock of one process than it tolerates.

    Other samples of these twins lie behind it, and those before were of the present when another process received them: what
    lies ahead is no clock of its own, and would go into quarantine. The process that is late is killed, too.
    """
    prepare(postgres, TWINS)
    commands = [SKEWED.format(skew_s=skew_s) for skew_s in (-LATE_S, 120)]
    with fleet(tmp_path, [postgres] * 2, commands, clock_tolerance_s=str(TOLERANCE_S)) as (late, early):
        alive = [early.url]
        load = Load(lambda: list(alive), TWINS, int(time.time()) - PAST_S)
        load.until(lambda: min(load.sent.values()) > PAST_S)  # all twins are live: they go on by the clock
        alive.append(late.url)
        before = load.acknowledged
        load.until(lambda: load.acknowledged > before + 8 * TWINS)
        late.kill()
        alive.remove(late.url)
        before = load.acknowledged
        time.sleep(10)
        load.until(lambda: load.acknowledged > before + TWINS)  # by the other one
        load.end()
        assert_nothing_lost(postgres, load, "clocks 9 min apart, SIGKILL of an owner")
    with psycopg.connect(postgres) as connection:
        assert connection.execute("SELECT count(*) FROM aside").fetchone() == (0,)


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
                load.until(lambda: load.acknowledged > 4 * TWINS)
                primary.kill()
                load.until(lambda: load.refused > 0)
                before = load.acknowledged
                with psycopg.connect(standby.url, autocommit=True) as connection:
                    connection.execute("ALTER SYSTEM SET synchronous_standby_names = ''")
                    connection.execute("SELECT pg_promote()")
                load.until(lambda: load.acknowledged > before)
                time.sleep(8)
                load.end()
                assert_nothing_lost(url, load, "failover to a promoted standby")
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
                load.until(lambda: load.acknowledged > 4 * TWINS)
                with contextlib.suppress(OSError), ballast.open("wb") as file:
                    while True:
                        file.write(b"0" * 4096)
                        file.flush()
                load.until(lambda: load.refused > 0)
                during = load.acknowledged
                ballast.unlink()
                load.until(lambda: load.acknowledged > during + TWINS)
                load.end()
                assert_nothing_lost(url, load, "the database's disk is full")
        finally:
            connection.execute(f"DROP SCHEMA {name} CASCADE")  # type: ignore[call-overload]
            connection.execute(f"DROP TABLESPACE {name}")  # type: ignore[call-overload]


def test_a_worker_is_killed(tmp_path: Path, postgres: str, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare(postgres, 1)
    gate = tmp_path / "gate"
    monkeypatch.setenv(GATE, str(gate))
    with fleet(tmp_path, [postgres] * 3, [FAKE, WORKER, WORKER]) as (service, *workers):
        jobs = calibrations(service, 3)

        def held() -> dict[str, str]:
            with psycopg.connect(postgres) as connection:
                return dict(connection.execute("SELECT id, worker FROM job WHERE state = 'running'").fetchall())

        while len(first := held()) < 3:  # the service itself does one, each worker another one
            time.sleep(0.1)
        victim = next(job for job, name in first.items() if f":{workers[0].process.pid}:" in name)
        workers[0].kill()
        gate.touch()
        assert_jobs_done_once(postgres, jobs, "SIGKILL of a worker")
        with psycopg.connect(postgres) as connection:
            name, attempt = connection.execute("SELECT worker, attempt FROM job WHERE id = %s", (victim,)).fetchone()  # type: ignore[misc]
        assert name != first[victim] and attempt == 2
