"""Load for a fleet, and what must hold of it afterwards: every acknowledged sample is there once, with the right residual."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psycopg

from service.store import models, residuals, samples, twins
from service.store.connection import Connection
from service.store.database import Database
from tests.service.conftest import SPEC
from tests.service.server import FAKE, Server

BEGIN_S = 1_700_000_000
MODEL = {"rmse_K": 0.1, "max_step_s": 60.0, "spec": SPEC, "effects": []}
SKEWED = "import time; real = time.time_ns; time.time_ns = lambda: real() + {skew_s} * 10**9;" + FAKE


def names(count: int) -> list[str]:
    """Return the names of twins."""
    return [f"sat-{k}" for k in range(count)]


def prepare(url: str, count: int) -> None:
    """Register twins, each with an active model."""
    database = Database(url)

    def fill(connection: Connection) -> None:
        for name in names(count):
            made, _ = twins.register(connection, name, {**SPEC, "twin": name})
            summary = {"epoch_us": BEGIN_S * 10**6, "train": {}, "validation": {"rmse_K": 0.1}, "effects": []}
            models.add(connection, made.key, "manual", summary, MODEL)
            models.activate(connection, made.key, 1, "requested")

    database.submit(fill).result(30)
    database.close()


@contextlib.contextmanager
def fleet(folder: Path, urls: Sequence[str], commands: Sequence[str] | None = None) -> Iterator[list[Server]]:
    """Yield running services, one for each URL of the database."""
    with contextlib.ExitStack() as stack:
        servers = []
        for number, url in enumerate(urls):
            place = folder / f"server{number}"
            place.mkdir()
            command = FAKE if commands is None else commands[number]
            server = Server(place, command, database_url=url, log_level="warning", clock_tolerance_s="0")
            servers.append(stack.enter_context(server))
        yield servers


class Load:
    """Sends samples of every twin to whichever service answers, each again until it is acknowledged."""

    def __init__(self, urls: Callable[[], list[str]], count: int) -> None:
        """Begin to send to the services that there are at a time."""
        self._urls, self._stop = urls, threading.Event()
        self.sent = {name: 0 for name in names(count)}
        self.refused = 0
        self.wrong: list[str] = []
        """Answers that no client should get: every test fails if there is one."""
        self._threads = [threading.Thread(target=self._send, args=(names(count)[k::2],)) for k in range(2)]
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        """Stop after what is under way."""
        self._stop.set()
        for thread in self._threads:
            thread.join(60)
            assert not thread.is_alive(), "a request has had no answer for a minute"

    @property
    def acknowledged(self) -> int:
        """How many samples were acknowledged so far, of all twins together."""
        return sum(self.sent.values())

    def until(self, is_so: Callable[[], bool], wait_s: float = 60.0) -> None:
        """Return once something is so."""
        end_s = time.monotonic() + wait_s
        while not is_so():
            assert time.monotonic() < end_s, (
                f"{self.acknowledged} acknowledged, {self.refused} refused, {self.wrong[:1]}"
            )
            time.sleep(0.05)

    def _send(self, own: list[str]) -> None:
        turn = 0
        with httpx.Client(timeout=10.0, trust_env=False) as client:
            while not self._stop.is_set():
                for name in own:
                    turn += 1
                    self._deliver(client, name, turn)
                time.sleep(0.05)

    def _deliver(self, client: httpx.Client, name: str, turn: int) -> None:
        first = self.sent[name]
        body = {"time": [BEGIN_S + first + k for k in range(2)], "values": _values(name, first, 2)}
        while True:
            urls = self._urls()
            try:
                answer = client.post(f"{urls[turn % len(urls)]}/v1/twins/{name}/telemetry", json=body)
                if answer.status_code == 200:
                    report = answer.json()
                    if report["accepted"] + report["duplicates"] != 2 or report["rejected"]:
                        self.wrong.append(f"{name}: {report}")
                    self.sent[name] = first + 2
                    return
                if answer.status_code not in (503, 507):
                    self.wrong.append(f"{name}: {answer.status_code} {answer.text}")
            except httpx.TransportError:
                pass  # the process was killed: counted below, and sent again to another
            self.refused += 1
            turn += 1
            if self._stop.is_set():
                return
            time.sleep(0.1)


def _values(name: str, first: int, count: int) -> dict[str, list[float]]:
    walk = _walk(name)[first : first + count]
    return {"T_px": walk.tolist(), "T_tank": (walk / 10 - 20).tolist(), "Q_px": [5.0] * count}


def _walk(name: str) -> np.ndarray:
    generator = np.random.default_rng(sum(name.encode()))
    return 290 + np.cumsum(np.round(generator.normal(size=20_000), 3))


def assert_nothing_lost(url: str, load: Load, wait_s: float = 60.0) -> None:
    """Hold archive, residuals and epochs against what was sent; waits until everything is assimilated.

    The workbench predicts that nothing changes, so that residuals are first differences: those of readings that one process
    took over from another one, too.
    """
    assert load.wrong == []
    database = Database(url)
    try:
        end_s = time.monotonic() + wait_s
        for key, (name, sent) in enumerate(sorted(load.sent.items(), key=lambda one: int(one[0][4:])), start=1):
            archive = database.engine.read(lambda c, key=key: samples.select(c, key, 3, [0]))  # type: ignore[misc]
            assert archive.time_us.size >= sent > 0  # the last one may be stored and its answer lost
            assert archive.time_us.size <= sent + 2
            np.testing.assert_array_equal(np.diff(archive.time_us), 10**6)
            np.testing.assert_array_equal(archive.values[0], _walk(name)[: archive.time_us.size])
            while True:
                found = database.engine.read(lambda c, key=key: residuals.select(c, key, 1, 2))  # type: ignore[misc]
                if found.time_us.size == archive.time_us.size:
                    break
                assert time.monotonic() < end_s, f"{name}: {found.time_us.size} of {archive.time_us.size} residuals"
                time.sleep(0.2)
            expected = np.diff(archive.values[0], prepend=archive.values[0, 0])
            np.testing.assert_array_equal(found.time_us, archive.time_us)
            np.testing.assert_allclose(found.innovation_K[0], expected, atol=1e-5)  # single precision
    finally:
        database.close()
    with psycopg.connect(url) as connection:
        rows = connection.execute(
            "SELECT slot, epoch, owner, from_us, lead(from_us) OVER (PARTITION BY slot ORDER BY epoch) FROM tenure"
        ).fetchall()
        assert rows and all(later is None or later >= begun for _, _, _, begun, later in rows)
        double = connection.execute(
            "SELECT twin, seq, count(*) FROM event GROUP BY 1, 2 HAVING count(*) > 1"
        ).fetchall()
        assert double == []


def present(server: Server) -> dict[str, Any]:
    """Return every twin as a service lists it."""
    answer = httpx.get(f"{server.url}/v1/twins", timeout=10.0, trust_env=False).json()
    return {twin["id"]: twin for twin in answer["twins"]}
