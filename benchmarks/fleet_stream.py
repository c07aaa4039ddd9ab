"""A fleet as it lives: a thousand spacecraft stream into two service processes on one PostgreSQL, forecasts asked meanwhile.

Every spacecraft has nine radiating nodes and parameters of its own; telemetry is the rollout of its true network under an orbit's
heat, with noise, one sample of twelve channels a minute at the instant it is dated. What is told: whether every acknowledged
sample is stored once and followed by the filter, how far the state behind a forecast is from the newest sample, what
it costs. ``python -m benchmarks.fleet_stream`` writes ``benchmarks/tables/fleet_stream.md``.
"""

import argparse
import asyncio
import contextlib
import os
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from benchmarks.fleet import services
from benchmarks.fleet_world import N_LOADS, N_NODES, NOISE_K, ORBIT_S, flight, model_of, specification
from benchmarks.markdown import markdown_table, save_table
from service.instants import parse_instant
from service.store import models, residuals, samples, twins
from service.store.connection import Connection
from service.store.database import Database
from tests.service.postgres import fresh_database, own_server
from twin_core.network.spec_io import load_spec

HORIZON_S = ORBIT_S
LANES = 8
"""Requests under way at a time."""
LEAD_S = 30.0
"""From the start of the services to the first sample."""
BYTES = 8 * (N_NODES + N_LOADS + 3) + 4 * (2 * N_NODES + 1) + 2 * 8
"""Of a sample its values, instant, reception and number; of its residuals values, deviations and NIS in single precision, too."""
ATTEMPTS = 20
LEAST = 3
"""Samples that a spacecraft has sent before anybody asks for its forecast."""


@dataclass
class Told:
    """What was seen from outside."""

    acknowledged: list[int]
    newest_s: list[float]
    latency_s: list[float] = field(default_factory=list)
    refused: int = 0
    forecast_s: list[float] = field(default_factory=list)
    behind_s: list[float] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)


def prepare(url: str, count: int, n_times: int, every_s: float, begin_s: float) -> list[dict[str, NDArray[np.float64]]]:
    """Register the spacecraft, each with its model active; return what each of them will read."""
    flights = []
    database = Database(url)
    for k in range(count):
        rng = np.random.default_rng(k)
        document = specification(f"sat-{k:04}")
        model = model_of(load_spec(document), rng)
        flights.append(flight(model, every_s * np.arange(n_times), rng))
        text = model.to_json()

        def register(connection: Connection, document: dict[str, Any] = document, text: Any = text) -> None:
            twin, _ = twins.register(connection, document["twin"], document)
            span = {"epoch_us": round(begin_s * 1e6), "train": {}, "validation": {"rmse_K": NOISE_K}, "effects": []}
            models.add(connection, twin.key, "manual", span, text)
            models.activate(connection, twin.key, 1, "requested")

        database.submit(register).result()
    database.close()
    return flights


@dataclass(frozen=True)
class Streaming:
    """Spacecraft that send what they read, each sample when it is due, and somebody who asks for forecasts."""

    urls: list[str]
    flights: list[dict[str, NDArray[np.float64]]]
    every_s: float
    begin_s: float
    client: httpx.AsyncClient
    told: Told
    free: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(LANES))

    async def spacecraft(self, twin: int) -> None:
        """Send every sample of one spacecraft, spread over the interval among the others."""
        for number in range(self.flights[twin]["T0"].size):
            due_s = self.begin_s + (number + twin / len(self.flights)) * self.every_s
            await asyncio.sleep(max(due_s - time.time(), 0.0))
            self.told.late_s.append(time.time() - due_s)
            values = {name: [float(column[number])] for name, column in self.flights[twin].items()}
            begun = time.perf_counter()
            if await self._is_acknowledged(twin, number, {"time": [round(due_s, 6)], "values": values}):
                self.told.latency_s.append(time.perf_counter() - begun)
                self.told.acknowledged[twin] += 1
                self.told.newest_s[twin] = round(due_s, 6)

    async def _is_acknowledged(self, twin: int, number: int, body: dict[str, Any]) -> bool:
        """Send a sample, again to another service where it was not acknowledged; return whether it was in the end."""
        for attempt in range(ATTEMPTS):
            url = self.urls[(twin + number + attempt) % len(self.urls)]
            try:
                async with self.free:  # the client's own queue of a thousand would cost more than the requests
                    answer = await self.client.post(f"{url}/v1/twins/sat-{twin:04}/telemetry", json=body)
                if answer.status_code == 200:
                    return True
                self.told.failed.append(f"ingest {answer.status_code}: {answer.text[:120]}")
            except httpx.TransportError as error:
                self.told.failed.append(f"ingest {type(error).__name__}")
            self.told.refused += 1
            await asyncio.sleep(0.5)
        return False

    async def ask(self, every_s: float) -> None:
        """Ask for the forecast of a spacecraft at random every so often, and how far behind its newest sample it is."""
        rng = np.random.default_rng(1)
        while True:
            await asyncio.sleep(every_s)
            twin, url = int(rng.integers(len(self.flights))), self.urls[int(rng.integers(len(self.urls)))]
            if self.told.acknowledged[twin] < LEAST:
                continue
            newest, begun = self.told.newest_s[twin], time.perf_counter()
            query = f"horizon_s={HORIZON_S:g}&step_s=60"
            try:
                answer = await self.client.get(f"{url}/v1/twins/sat-{twin:04}/forecast?{query}")
            except httpx.TransportError as error:
                self.told.failed.append(f"forecast {type(error).__name__}")
                continue
            if answer.status_code != 200:
                self.told.failed.append(f"forecast {answer.status_code}: {answer.text[:120]}")
                continue
            self.told.forecast_s.append(time.perf_counter() - begun)
            self.told.behind_s.append(max(newest - parse_instant(answer.json()["from"], "from") / 1e6, 0.0))


async def stream(
    urls: list[str],
    flights: list[dict[str, NDArray[np.float64]]],
    every_s: float,
    begin_s: float,
    forecast_every_s: float,
) -> Told:
    """Let every spacecraft send what it reads, and ask for forecasts all the while; return what was seen."""
    told, limits = Told([0] * len(flights), [0.0] * len(flights)), httpx.Limits(max_connections=2 * LANES)
    async with httpx.AsyncClient(timeout=30.0, trust_env=False, limits=limits) as client:
        streaming = Streaming(urls, flights, every_s, begin_s, client, told)
        asking = asyncio.create_task(streaming.ask(forecast_every_s))
        await asyncio.gather(*(streaming.spacecraft(twin) for twin in range(len(flights))))
        asking.cancel()
    return told


def cpu_s(session: int) -> float:
    """Return the processor time of all living processes of a session, and of children that left it, in seconds."""
    total = 0.0
    for place in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = place.read_text().rpartition(")")[2].split()
            if session in (int(fields[1]), int(fields[3])):
                total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def memory_MB(session: int) -> float:
    """Return the memory that the processes of a session hold, shared pages counted once each process, in MB."""
    total = 0.0
    for place in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = place.read_text().rpartition(")")[2].split()
            if session in (int(fields[1]), int(fields[3])):
                total += int(fields[21]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return total


def verify(url: str, told: Told, wait_s: float) -> tuple[int, int, int, float, float]:
    """Return samples stored, those twice, residuals, mean NIS per sensor, and how long the filter took to follow all, in s."""
    database, begun = Database(url), time.monotonic()
    stored = twice = followed = 0
    nis: list[NDArray[np.float64]] = []
    for key in range(1, len(told.acknowledged) + 1):
        archive = database.engine.read(lambda c, key=key: samples.select(c, key, N_NODES + N_LOADS, [0]))  # type: ignore[misc]
        while True:
            found = database.engine.read(lambda c, key=key: residuals.select(c, key, 1, N_NODES))  # type: ignore[misc]
            if found.time_us.size >= archive.time_us.size or time.monotonic() - begun > wait_s:
                break
            time.sleep(0.1)
        stored += archive.time_us.size
        twice += archive.time_us.size - np.unique(archive.time_us).size
        followed += found.time_us.size
        nis.append(found.nis[5:] / N_NODES)
    database.close()
    every = np.concatenate(nis)
    return stored, twice, followed, float(np.nanmean(every)) if every.size else float("nan"), time.monotonic() - begun


@dataclass(frozen=True)
class Cost:
    """What the processes took: processor time of services and database in s, memory of the services in MB."""

    services_s: float
    database_s: float
    memory_MB: float


def quantiles(values: list[float], unit: str, scale: float = 1.0) -> str:
    """Return median, 99 % and greatest of some values in words."""
    if not values:
        return "none"
    median, high, most = (scale * float(np.quantile(values, q)) for q in (0.5, 0.99, 1.0))
    return f"{median:.3g} {unit} (99 %: {high:.3g}, longest {most:.3g})"


def rows_of(told: Told, found: tuple[int, int, int, float, float], cost: Cost, due: int) -> list[list[str]]:
    """Return the table: what was seen from outside, what ``verify`` found, what it took; ``due`` samples were to be sent."""
    stored, twice, followed, nis, wait_s = found
    acknowledged = sum(told.acknowledged)
    each_ms = 1e3 / max(acknowledged, 1)
    wrong = f"{len(told.failed)}: {', '.join(sorted(set(told.failed))[:3])}" if told.failed else "none"
    return [
        ["samples acknowledged", f"{acknowledged:,} of {due:,}, {told.refused} refused and sent again"],
        ["stored; twice; lost", f"{stored:,}; {twice}; {max(acknowledged - stored, 0)}"],
        ["followed by the filter", f"{followed:,}, all of it {wait_s:.1f} s after the last sample at most"],
        ["mean NIS over its expectation", f"{nis:.3f}"],
        [f"ingest until the answer, waiting for one of {LANES} lanes included", quantiles(told.latency_s, "ms", 1e3)],
        ["forecasts, request to answer", f"{len(told.forecast_s):,}: {quantiles(told.forecast_s, 'ms', 1e3)}"],
        ["state behind the newest acknowledged sample", quantiles(told.behind_s, "s")],
        [
            "processor time per sample: services, database",
            f"{each_ms * cost.services_s:.1f} ms, {each_ms * cost.database_s:.1f} ms",
        ],
        ["memory of all service processes", f"{cost.memory_MB:,.0f} MB"],
        ["answers other than 200", wrong],
        ["sender late against its own schedule", quantiles(told.late_s, "ms", 1e3)],
    ]


def sizes(told: Told, cost: Cost) -> str:
    """Return a table of what fleets of other sizes take that send a sample a minute, each at the cost measured here."""
    rows = []
    for count in (1_000, 10_000, 100_000):
        rate = count / 60.0
        each = rate / max(sum(told.acknowledged), 1)
        room = f"{rate * 86_400 * BYTES / 1e9:.1f}"
        cores = [f"{each * cost.services_s:.1f}", f"{each * cost.database_s:.1f}"]
        rows.append([f"{count:,}", f"{rate:,.0f}", *cores, room])
    return markdown_table(["spacecraft", "samples/s", "cores of services", "cores of the database", "GB a day"], rows)


def main() -> None:
    """Stream, verify and write the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--spacecraft", type=int, default=1000)
    parser.add_argument("--every", type=float, default=60.0, help="seconds between two samples of a spacecraft")
    parser.add_argument("--forecast-every", type=float, default=2.0, help="seconds between two forecasts")
    parser.add_argument("--services", type=int, default=2)
    parser.add_argument("--no-table", action="store_true", help="only print")
    arguments = parser.parse_args()
    count, every_s, n_services = arguments.spacecraft, arguments.every, arguments.services
    n_times = max(round(60.0 * arguments.minutes / every_s), 1)
    loads = [os.getloadavg()[0]]
    with contextlib.ExitStack() as stack:
        named = os.environ.get("TWIN_TEST_POSTGRES_URL")
        server = None if named else stack.enter_context(own_server("fsync=on"))
        url = stack.enter_context(fresh_database(named or server.url))  # type: ignore[union-attr]
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        begun = time.perf_counter()
        flights = prepare(url, count, n_times, every_s, time.time())
        print(f"prepared in {time.perf_counter() - begun:.0f} s", flush=True)
        command, settings = [sys.executable, "-m", "service"], {"TWIN_CLOCK_TOLERANCE_S": "60"}
        running = stack.enter_context(services(url, n_services, folder, command=command, **settings))
        urls, pids = [one for one, _ in running], [process.pid for _, process in running]
        told = asyncio.run(stream(urls, flights, every_s, time.time() + LEAD_S, arguments.forecast_every))
        loads.append(os.getloadavg()[0])
        found = verify(url, told, 120.0)
        database_s = 0.0 if server is None or server.process is None else cpu_s(server.process.pid)
        cost = Cost(sum(map(cpu_s, pids)), database_s, sum(map(memory_MB, pids)))
        print((folder / "server.log").read_text()[-3000:], flush=True)
    table = markdown_table(
        ["what", "measured"],
        [
            ["spacecraft, processes, minutes", f"{count:,}, {n_services}, {arguments.minutes:g}"],
            *rows_of(told, found, cost, count * n_times),
            ["load average at begin and end (two cores)", ", ".join(f"{one:.1f}" for one in loads)],
        ],
    )
    print(table)
    if not arguments.no_table:
        note = (
            "Sender, services and database share the cores with other work, see the load average. A forecast spans one orbit; "
            "the state behind it is compared with the newest sample acknowledged before it was asked for."
        )
        save_table("fleet_stream", "A thousand spacecraft, streaming", table, "benchmarks.fleet_stream", note)
        note = (
            "One sample of twelve channels a minute from each, at the processor time per sample of fleet_stream.md (the start of "
            f"the processes included) and {BYTES} bytes of samples and residuals."
        )
        save_table("fleet_sizes", "Sizes of fleets, on paper", sizes(told, cost), "benchmarks.fleet_stream", note)


if __name__ == "__main__":
    main()
