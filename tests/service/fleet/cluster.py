"""A Dask cluster whose parts a test may kill."""

import os
import signal
import socket
import subprocess
import sys


class Cluster:
    """A scheduler and a worker, each a process that a test may kill."""

    def __init__(self, port: int | None = None) -> None:
        """Start both, at a free port unless one is named."""
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = port or free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self._port}"
        self.scheduler = self.add_scheduler()
        self.worker = self.add_worker()

    def add_scheduler(self) -> "subprocess.Popen[bytes]":
        """Start a scheduler at the address of the cluster."""
        options = ("--host", "127.0.0.1", "--port", str(self._port), "--no-dashboard")
        return self._start("dask_scheduler", *options)

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
