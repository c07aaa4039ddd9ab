"""Ingest of the service beside what bounds it, in one run on one machine.

Two things cannot be avoided, and both are measured beside the service, in turn with it:

- ``bare``: the way over HTTP. A minimal endpoint of the same server parses the same bodies, sent by the same clients.
- ``raw SQLite``: the durable commit. The same rows inserted in a plain loop, one transaction per request, with the same
  durability (WAL, synchronous=FULL).

The bound follows from how they may overlap. Several clients keep both busy at once, so no more than the slower of the two is
possible: bound = min(bare, raw). One client that waits for each answer has nothing else under way: its request travels, is
committed, and only then is answered, so that their times add: 1 / bound = 1 / bare + 1 / raw. Sharing commits among requests
that wait together is not in the bound of several clients, so that on a slow disk the service may exceed it; nor is that the
service stores a large batch as one segment, which takes less than a thousand rows.

``python -m benchmarks.service`` writes ``benchmarks/tables/service.md``.
"""

import argparse
import http.client
import json
import os
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from benchmarks.markdown import markdown_table, save_table

CHANNELS = 12
BARE = """
import sys, uvicorn, orjson
from fastapi import FastAPI, Request
app = FastAPI()

@app.post("/parse")
async def parse(request: Request) -> dict[str, int]:
    return {"accepted": len(orjson.loads(await request.body())["time"])}

class Announcing(uvicorn.Server):
    async def startup(self, sockets=None):
        await super().startup(sockets)
        print("listening on http://127.0.0.1:%d" % self.servers[0].sockets[0].getsockname()[1], flush=True)
Announcing(uvicorn.Config(app, port=0, log_config=None, access_log=False)).run()
"""


@contextmanager
def running(arguments: list[str], folder: Path) -> Iterator[str]:
    """Yield the URL of a server process."""
    environment = {**os.environ, "TWIN_PORT": "0", "TWIN_DATABASE_URL": f"sqlite:///{folder / 'bench.sqlite3'}"}
    with (folder / "server.log").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, *arguments], env=environment, stdout=subprocess.PIPE, stderr=log, text=True
        )
    assert process.stdout is not None
    try:
        yield process.stdout.readline().removeprefix("listening on ").strip()
    finally:
        process.terminate()
        process.wait()
        process.stdout.close()


def specification() -> dict[str, object]:
    """Return a twin of a dozen sensors."""
    names = [f"T_{k}" for k in range(CHANNELS)]
    return {
        "twin": "bench",
        "channels": {name: {"kind": "temperature", "unit": "K"} for name in names},
        "nodes": [{"id": f"n{k}", "sensor": name} for k, name in enumerate(names)],
    }


def bodies(count: int, frames: int, lane: int) -> list[bytes]:
    """Return request bodies with samples that nobody sent before."""
    generator = np.random.default_rng(lane)
    made = []
    for number in range(count):
        start = lane * 100_000 + number * frames
        time_s = [start + k for k in range(frames)]
        values = {f"T_{c}": np.round(290 + generator.normal(size=frames), 3).tolist() for c in range(CHANNELS)}
        made.append(json.dumps({"time": time_s, "values": values}).encode())
    return made


def post_all(url: str, path: str, payloads: list[bytes], latencies_s: list[float]) -> None:
    """Send bodies over one connection that stays open."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port)
    for body in payloads:
        begun = time.perf_counter()
        connection.request("POST", path, body, {"Content-Type": "application/json"})
        response = connection.getresponse()
        answer = response.read()
        if response.status >= 300:
            raise RuntimeError(answer.decode())
        latencies_s.append(time.perf_counter() - begun)
    connection.close()


def rate(url: str, path: str, frames: int, requests: int, clients: int, lane: int) -> tuple[float, float]:
    """Return frames per second and the 99th percentile of the latency."""
    lanes = [bodies(requests, frames, lane * 100 + client) for client in range(clients)]
    latencies_s: list[float] = []
    threads = [threading.Thread(target=post_all, args=(url, path, lanes[c], latencies_s)) for c in range(clients)]
    begun = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    elapsed_s = time.perf_counter() - begun
    return frames * requests * clients / elapsed_s, statistics.quantiles(latencies_s, n=100)[98]


def raw_sqlite(folder: Path, frames: int, requests: int) -> float:
    """Return frames per second of plain row inserts, a transaction per request."""
    connection = sqlite3.connect(folder / "raw.sqlite3", isolation_level=None)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")
    columns = ", ".join(f"c{k} REAL" for k in range(CHANNELS))
    connection.execute(
        f"CREATE TABLE IF NOT EXISTS frame (twin INTEGER, time INTEGER, {columns}, PRIMARY KEY (twin, time))"
    )
    connection.execute("DELETE FROM frame")
    statement = f"INSERT INTO frame VALUES (1, ?{', ?' * CHANNELS})"
    values = np.random.default_rng(0).normal(size=(frames, CHANNELS)).tolist()
    begun = time.perf_counter()
    for number in range(requests):
        rows = [(number * frames + k, *values[k]) for k in range(frames)]
        connection.execute("BEGIN")
        connection.executemany(statement, rows)
        connection.execute("COMMIT")
    elapsed_s = time.perf_counter() - begun
    connection.close()
    return frames * requests / elapsed_s


@dataclass(frozen=True)
class Case:
    """One way to send samples."""

    label: str
    frames: int
    requests: int
    clients: int
    target: str


CASES = (
    Case("1000 frames", 1000, 60, 1, "60 %"),
    Case("50 frames", 50, 400, 1, "60 %"),
    Case("50 frames, 8 clients", 50, 100, 8, "60 %"),
    Case("1 frame", 1, 400, 1, "60 %"),
    Case("1 frame, 8 clients", 1, 250, 8, "60 %"),
)
HEADER = ["case", "service", "bare endpoint", "raw SQLite", "bound", "share of the bound", "target", "p99"]


def bound(bare_per_s: float, raw_per_s: float, clients: int) -> float:
    """Return the frames per second that HTTP and a commit of rows per request allow; see the module's words."""
    if clients == 1:
        return 1.0 / (1.0 / bare_per_s + 1.0 / raw_per_s)
    return min(bare_per_s, raw_per_s)


def contest(case: Case, service: str, bare: str, folder: Path, rounds: int, first_lane: int) -> list[str]:
    """Return a row of the table: the best of some rounds, in which the contestants take turns."""
    reached: dict[str, list[float]] = {"service": [], "bare": [], "sqlite": []}
    latencies_s = []
    size = (case.frames, case.requests, case.clients)
    for lane in range(first_lane, first_lane + rounds):
        rate_per_s, p99_s = rate(service, "/v1/twins/bench/telemetry", *size, lane)
        reached["service"].append(rate_per_s)
        latencies_s.append(p99_s)
        reached["bare"].append(rate(bare, "/parse", *size, lane)[0])
        reached["sqlite"].append(raw_sqlite(folder, case.frames, case.requests))
    best = {name: max(rates) for name, rates in reached.items()}
    most = bound(best["bare"], best["sqlite"], case.clients)
    figures = [f"{figure:,.0f}" for figure in (best["service"], best["bare"], best["sqlite"], most)]
    return [case.label, *figures, f"{best['service'] / most:.0%}", case.target, f"{1e3 * min(latencies_s):.1f} ms"]


def main() -> None:
    """Print one line per case and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3, help="Rounds, of which the best counts for each contestant.")
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        raw_commits = raw_sqlite(folder, 1, 200)
        with running(["-m", "service"], folder) as service, running(["-c", BARE], folder) as bare:
            post_all(service, "/v1/twins", [json.dumps(specification()).encode()], [])
            rows = []
            for number, case in enumerate(CASES):
                rows.append(contest(case, service, bare, folder, rounds, 1 + number * rounds))
                print(" | ".join(rows[-1]), flush=True)
    commit_ms = 1e3 / raw_commits
    note = (
        f"Frames per second of {CHANNELS} channels, the best of {rounds} rounds. A durable commit took {commit_ms:.2f} ms here. "
        "Of one client, which waits for each answer, the bound is the way over HTTP and the commit one after the other; of "
        "several, the slower of the two. Where a commit is slow, requests share it, and the service exceeds raw inserts; so it "
        "does with a thousand frames, which it stores as one segment and not as rows. "
        f"Load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."
    )
    save_table("service", "Ingest", markdown_table(HEADER, rows), "benchmarks.service", note)


if __name__ == "__main__":
    main()
