"""A real service: a process of its own on a free port, for tests of sockets, signals and crashes."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from service.client import Retry, TwinClient

READY = "listening on "
FAKE = (
    "from service.server import serve; from service.settings import read_settings;"
    "from tests.service.fakes import FakeWorkbench;"
    "serve(read_settings(), lambda url: print('listening on', url, flush=True), FakeWorkbench)"
)
"""A server whose workbench answers at once."""


class Server:
    """Starts ``python -m service`` and ends it; the log lies beside the database."""

    def __init__(self, folder: Path, command: str | None = None, within: Sequence[str] = (), **settings: str) -> None:
        """Keep the database in ``folder``; settings are ``TWIN_*`` variables without the prefix.

        ``within`` is a command that runs another one: in a network of its own, say.
        """
        self._within = within
        self._folder = folder
        self._arguments = ["-m", "service"] if command is None else ["-c", command]
        own = {"port": "0", "database_url": f"sqlite:///{folder / 'twin.sqlite3'}", **settings}
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("TWIN_")}
        self._environment = inherited | {f"TWIN_{name.upper()}": value for name, value in own.items()}
        self.url = ""
        self._clients: list[TwinClient] = []

    def start(self) -> Self:
        """Start the process and wait until it answers."""
        with (self._folder / "server.log").open("ab") as log:
            self.process = subprocess.Popen(
                [*self._within, sys.executable, *self._arguments],
                env=self._environment,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                start_new_session=True,
            )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith(READY), self.log()
        self.url = line.removeprefix(READY).strip()
        return self

    def client(self, key: str | None = None) -> TwinClient:
        """Return a client that gives up at once, so that a test sees what happens; it is closed with the server."""
        client = TwinClient(self.url, key, retry=Retry(attempts=1), timeout_s=120.0)  # a busy machine takes its time
        self._clients.append(client)
        return client

    def kill(self) -> None:
        """End the process as a crash would."""
        self.process.kill()
        self._wait()

    def stop(self) -> int:
        """End the process in good order and return its status."""
        self.process.terminate()
        return self._wait()

    def _wait(self) -> int:
        status = self.process.wait(60)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return status

    def __enter__(self) -> Self:
        """Start."""
        return self.start()

    def __exit__(self, *_: object) -> None:
        """End the process if it still runs."""
        for client in self._clients:
            client.close()
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self._wait()

    def log(self) -> str:
        """Return what the server logged."""
        return (self._folder / "server.log").read_text()
