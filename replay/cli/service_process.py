"""The service as a process of its own, on a free port, with its files in a folder, and gone when the block ends."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from twin_core.errors import TwinError

READY = "listening on "
STOP_S = 15.0


class ServiceFailed(TwinError):
    """The service did not start."""


@contextmanager
def running_service(folder: Path) -> Iterator[str]:
    """Yield the URL of a service that keeps its database and log in ``folder``.

    The process leads a group of its own: Ctrl-C reaches this program alone, and nothing of the group outlives the block.

    Raises
    ------
    ServiceFailed
        With the last line of the log if the service ends before it is ready.
    """
    log = folder / "service.log"
    with log.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "service"],
            env=_environment(folder),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stream,
            start_new_session=True,
        )
        try:
            yield _await_url(process, log)
        finally:
            _stop(process)


def _environment(folder: Path) -> dict[str, str]:
    """Return this process's environment with none of its TWIN_ settings but those that keep the service private."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("TWIN_")}
    return inherited | {
        "TWIN_HOST": "127.0.0.1",
        "TWIN_PORT": "0",
        "TWIN_DATABASE_URL": f"sqlite:///{folder / 'twin.sqlite3'}",
    }


def _await_url(process: subprocess.Popen[bytes], log: Path) -> str:
    """Return the URL that the service announces once it answers."""
    assert process.stdout is not None
    for line in process.stdout:
        text = line.decode(errors="replace").strip()
        if text.startswith(READY):
            return text.removeprefix(READY)
    process.wait()
    said = log.read_text(errors="replace").strip().splitlines()
    raise ServiceFailed(f"the service did not start: {said[-1] if said else 'it said nothing'}")


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End the process, in good order if it can, and whatever is left of its group."""
    process.terminate()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
    with suppress(ProcessLookupError, PermissionError):  # usually nothing is left of the group
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdout is not None:
        process.stdout.close()
