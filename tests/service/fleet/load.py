"""Load for a fleet, and what must hold of it afterwards: every acknowledged sample is there once, with the right residual."""

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import httpx
import numpy as np
import psycopg

from service.store import models, ownership, residuals, samples, twins
from service.store.connection import Connection
from service.store.database import Database
from tests.service.conftest import SPEC
from tests.service.fakes import GATED
from tests.service.server import FAKE, Server

REPORT = os.environ.get("FLEET_FAULTS")
"""A file that hears what every fault has cost, a line of JSON each."""
KEY = "secret"
BEGIN_S = 1_700_000_000
MODEL = {"rmse_K": 0.1, "max_step_s": 60.0, "spec": SPEC, "effects": []}
WITNESS = f"""
    CREATE TABLE written (
        number BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, twin BIGINT, epoch BIGINT, writer TEXT
    );
    CREATE FUNCTION witness() RETURNS trigger LANGUAGE plpgsql AS $$BEGIN
        INSERT INTO written (twin, epoch, writer)
        SELECT NEW.twin, slot.epoch, host(inet_client_addr()) || ':' || inet_client_port()
        FROM slot WHERE slot.number = mod(NEW.twin * {ownership.SPREAD}, {ownership.SLOTS});
        RETURN NULL;
    END$$;
    CREATE TRIGGER witness AFTER INSERT OR UPDATE ON checkpoint FOR EACH ROW EXECUTE FUNCTION witness();
"""
"""The database notes by itself which connection writes the live state of a twin in which epoch."""
WORKER = FAKE.replace("service.server import serve", "service.worker import work").replace(
    "serve(read_settings(), lambda url: print('listening on', url, flush=True), FakeWorkbench)",
    "work(read_settings(), lambda: print('listening on', 'nothing', flush=True), FakeWorkbench)",
)
"""A process that does jobs and serves nobody."""
LOGGED = "from service.monitoring.logs import start_logging; start_logging('info');"
SKEWED = "import time; real = time.time_ns; time.time_ns = lambda: real() + {skew_s} * 10**9;" + FAKE
STARTED: list["Load"] = []
"""What may still be sending: a test that fails leaves its load behind."""


def names(count: int) -> list[str]:
    """Return the names of twins."""
    return [f"sat-{k}" for k in range(count)]


def prepare(url: str, count: int, *, is_watched: bool = True) -> None:
    """Register twins, each with an active model, and let the database note who writes their live state."""
    database = Database(url)

    def fill(connection: Connection) -> None:
        for name in names(count):
            made, _ = twins.register(connection, name, {**SPEC, "twin": name})
            summary = {"epoch_us": BEGIN_S * 10**6, "train": {}, "validation": {"rmse_K": 0.1}, "effects": []}
            models.add(connection, made.key, "manual", summary, MODEL)
            models.activate(connection, made.key, 1, "requested")

    database.submit(fill).result(30)
    database.close()
    if is_watched:
        with psycopg.connect(url) as connection:
            connection.execute(WITNESS)


@contextlib.contextmanager
def fleet(
    folder: Path, urls: Sequence[str], commands: Sequence[str] | None = None, **settings: str
) -> Iterator[list[Server]]:
    """Yield running services, one for each URL of the database."""
    with contextlib.ExitStack() as stack:
        servers = []
        for number, url in enumerate(urls):
            place = folder / f"server{number}"
            place.mkdir()
            command = FAKE if commands is None else commands[number]
            own = {"database_url": url, "log_level": "warning", "clock_tolerance_s": "0"} | settings
            server = Server(place, command, **own)
            servers.append(stack.enter_context(server))
        yield servers


class Load:
    """Sends samples of every twin to whichever service answers, each again until it is acknowledged."""

    def __init__(self, urls: Callable[[], list[str]], count: int, begin_s: int = BEGIN_S) -> None:
        """Begin to send to the services that there are at a time: samples of the seconds from ``begin_s`` on, up to now."""
        self._urls, self._stop, self.begin_s = urls, threading.Event(), begin_s
        self.sent = {name: 0 for name in names(count)}
        self.refused = 0
        self.wrong: list[str] = []
        """Answers that no client should get: every test fails if there is one."""
        self._threads = [threading.Thread(target=self._send, args=(names(count)[k::2],), daemon=True) for k in range(2)]
        STARTED.append(self)
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Send nothing more."""
        self._stop.set()

    def end(self) -> None:
        """Stop after what is under way."""
        self.stop()
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
        with httpx.Client(timeout=10.0, trust_env=False, headers={"Authorization": f"Bearer {KEY}"}) as client:
            while not self._stop.is_set():
                for name in own:
                    if self.begin_s + self.sent[name] + 1 < time.time():
                        turn += 1
                        self._deliver(client, name, turn)
                time.sleep(0.05)

    def _deliver(self, client: httpx.Client, name: str, turn: int) -> None:
        first = self.sent[name]
        body = {"time": [self.begin_s + first + k for k in range(2)], "values": _values(name, first, 2)}
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


@dataclass(frozen=True)
class Tally:
    """What a fault has cost. Everything but the first two must be zero."""

    acknowledged: int
    refused: int
    lost: int = 0
    twice: int = 0
    wrong: int = 0
    """Samples whose values or residuals are not those of a service that nothing happened to, and answers nobody should get."""
    owned_twice: int = 0
    jobs_lost: int = 0
    jobs_twice: int = 0

    def note(self, fault: str) -> None:
        """Write it down for the table of faults, where somebody wants one."""
        if REPORT is not None:
            with Path(REPORT).open("a") as file:
                file.write(json.dumps({"fault": fault, **vars(self)}) + "\n")

    def assert_nothing_lost(self) -> None:
        """Fail if anything was lost, doubled or wrong."""
        assert (self.lost, self.twice, self.wrong, self.owned_twice, self.jobs_lost, self.jobs_twice) == (0,) * 6, self
        assert self.acknowledged > 0


def tally(url: str, load: Load, wait_s: float = 60.0) -> Tally:
    """Hold archive, residuals and epochs against what was sent; waits a while until everything is assimilated.

    The workbench predicts that nothing changes, so that residuals are first differences: those of readings that one process
    took over from another one, too.
    """
    lost = twice = wrong = 0
    end_s = time.monotonic() + wait_s
    with contextlib.closing(Database(url)) as database:
        for key, (name, sent) in enumerate(sorted(load.sent.items(), key=lambda one: int(one[0][4:])), start=1):
            archive = database.engine.read(lambda c, key=key: samples.select(c, key, 3, [0]))  # type: ignore[misc]
            raw = database.engine.read(lambda c, key=key: samples.since_seq(c, key, 3, 0)[0])  # type: ignore[misc]
            query = f"SELECT seq FROM event WHERE twin = {key}"
            told = database.engine.read(lambda c, query=query: [row[0] for row in c.execute(query)])  # type: ignore[misc]
            instants = (load.begin_s + np.arange(sent + 2)) * 10**6  # the last one may be stored and its answer lost
            lost += int((~np.isin(instants[:sent], archive.time_us)).sum())
            twice += raw.size - archive.time_us.size
            twice += (
                raw.size + len(told) - np.union1d(raw, told).size
            )  # one number for two samples, or for one and a message
            wrong += int((~np.isin(archive.time_us, instants)).sum())
            while True:
                found = database.engine.read(lambda c, key=key: residuals.select(c, key, 1, 2))  # type: ignore[misc]
                if found.time_us.size >= archive.time_us.size or time.monotonic() > end_s:
                    break
                time.sleep(0.2)
            expected = np.diff(archive.values[0], prepend=archive.values[0, :1])
            shared = min(found.time_us.size, expected.size)
            as_due = np.isclose(found.innovation_K[0, :shared], expected[:shared], atol=1e-5)  # single precision
            as_due &= found.time_us[:shared] == archive.time_us[:shared]
            as_due &= archive.values[0, :shared] == _walk(name)[:shared]
            wrong += max(found.time_us.size, expected.size) - int(as_due.sum())
    with psycopg.connect(url) as connection:
        query = "SELECT slot, epoch, owner, from_us, lead(from_us) OVER (PARTITION BY slot ORDER BY epoch) FROM tenure"
        rows = connection.execute(query).fetchall()
        owned_twice = sum(later is not None and later < begun for _, _, _, begun, later in rows) + (not rows)
        written = connection.execute("SELECT twin, epoch, writer FROM written ORDER BY number").fetchall()
        writers: dict[tuple[int, int], list[str]] = {}
        for twin, epoch, writer in written:
            writers.setdefault((twin, epoch), []).append(writer)
        for order in writers.values():  # whoever was followed by another one in an epoch does not come back in it
            turns = [writer for writer, _ in groupby(order)]
            owned_twice += len(turns) - len(set(turns))
        owned_twice += not written
    return Tally(load.acknowledged, load.refused, lost, twice, wrong + len(load.wrong), owned_twice)


def assert_nothing_lost(url: str, load: Load, fault: str, wait_s: float = 60.0) -> None:
    """Tally what a fault has cost, write it down, and fail if it is anything."""
    found = tally(url, load, wait_s)
    found.note(fault)
    found.assert_nothing_lost()


def calibrations(service: Server, count: int) -> list[str]:
    """Queue calibrations of the first twin, which wait for the gate; return their ids."""
    twin = f"{service.url}/v1/twins/sat-0"
    values = {"T_px": [290.0] * 60, "T_tank": [10.0] * 60, "Q_px": [GATED] * 60}
    with httpx.Client(timeout=60.0, trust_env=False) as client:
        assert client.post(f"{twin}/telemetry", json={"time": list(range(60)), "values": values}).status_code == 200
        answers = [client.post(f"{twin}/calibrations", json={}) for _ in range(count)]
    return [answer.headers["location"].rsplit("/", 1)[1] for answer in answers]


def assert_jobs_done_once(url: str, jobs: Sequence[str], fault: str, wait_s: float = 120.0) -> None:
    """Wait until jobs have ended; write down, and fail, if one did not succeed or left another number of models than one."""
    end_s = time.monotonic() + wait_s
    with psycopg.connect(url, autocommit=True) as connection:
        while True:
            query = "SELECT state FROM job WHERE id = ANY(%s)"
            states = [state for (state,) in connection.execute(query, (list(jobs),)).fetchall()]
            if not {"queued", "running"} & set(states) or time.monotonic() > end_s:
                break
            time.sleep(0.2)
        made = connection.execute("SELECT count(*) FROM model WHERE source = 'calibration'").fetchone()[0]  # type: ignore[index]
    done = states.count("succeeded")
    found = Tally(len(jobs), 0, jobs_lost=len(jobs) - done, jobs_twice=max(made - done, 0))
    found.note(fault)
    found.assert_nothing_lost()
