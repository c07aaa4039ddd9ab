"""What a large archive costs: jobs, memory, answers, exports, residuals on disk, deletion, a vast specification.

A million frames of twelve channels, sampled once a second, are ingested by a real server process; then each figure of
``docs/service.md#room`` is taken, and 100,000 frames of two hundred channels, sampled once a minute, are calibrated.
``python -m benchmarks.service_years [--frames N]`` writes ``benchmarks/tables/service_years.md``.
"""

import argparse
import contextlib
import json
import os
import sqlite3
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np

import benchmarks.service_life as life
from benchmarks.markdown import markdown_table, save_table
from benchmarks.service import post_all, running
from service.client import TwinClient
from service.jobs.executor import resident_MiB

Row = list[str]
VALUES_IN_PIECE = 24_000
N_NODES, N_WIDE = 11, 199
WIDE_FRAMES = 100_000
DAY_S = 84_000


def frames(count: int, n_nodes: int = N_NODES, step_s: int = 1) -> Iterator[bytes]:
    """Yield bodies with samples of a chain of nodes: a day that repeats, to its end, with noise of its own."""
    life.N_NODES, life.STEP_S = n_nodes, 60.0
    _, values = life.orbits(1500)
    generator = np.random.default_rng(3)
    minutes = np.arange(1500) * 60.0
    piece = VALUES_IN_PIECE // (n_nodes + 1)
    for first in range(0, count, piece):
        second = step_s * np.arange(first, min(first + piece, count))
        of_day = (second - step_s * count) % DAY_S
        made = {"Q": np.interp(of_day, minutes, values["Q"]).round(1).tolist()}
        for k in range(n_nodes):
            smooth = np.interp(of_day, minutes, values[f"T_n{k}"])
            made[f"T_n{k}"] = (smooth + generator.normal(0.0, 0.05, second.size)).round(3).tolist()
        yield json.dumps({"time": second.tolist(), "values": made}).encode()


@contextlib.contextmanager
def stalls(url: str) -> Iterator[list[float]]:
    """Yield the latencies in seconds of a small request that is sent again and again meanwhile."""
    done, found = threading.Event(), []

    def ask() -> None:
        with httpx.Client(base_url=url, trust_env=False, timeout=60.0) as http:
            while not done.is_set():
                begun_s = time.perf_counter()
                http.get("/readyz")
                found.append(time.perf_counter() - begun_s)
                time.sleep(0.005)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield found
    finally:
        done.set()
        thread.join()


@contextlib.contextmanager
def most_memory(folder: Path) -> Iterator[dict[str, float]]:
    """Yield the greatest memory in MiB of the server and of a worker, and the CPU seconds of the busiest job, by the end."""
    done, found = threading.Event(), {"server": 0.0, "worker": 0.0, "cpu_s": 0.0}
    tick_s = 1.0 / os.sysconf("SC_CLK_TCK")

    def look() -> None:
        while not done.wait(0.1):
            for entry in Path("/proc").iterdir():
                with contextlib.suppress(OSError, ValueError):
                    if str(folder).encode() not in (entry / "environ").read_bytes():
                        continue
                    what = "server" if b"-m\0service" in (entry / "cmdline").read_bytes() else "worker"
                    found[what] = max(found[what], resident_MiB(int(entry.name)))
                    spent = (entry / "stat").read_text().rpartition(")")[2].split()
                    if int(spent[16]) > os.nice(0):  # of lower priority than this process and the server: a job
                        found["cpu_s"] = max(found["cpu_s"], (int(spent[11]) + int(spent[12])) * tick_s)

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield found
    finally:
        done.set()
        thread.join()


def job(client: TwinClient, folder: Path, kind: str, target: str, twin: str = "chain", **settings: Any) -> Row:
    """Measure one job."""
    begun_s = time.perf_counter()
    with most_memory(folder) as memory:
        start = client.calibrate if kind == "calibration" else client.diagnose
        made = client.wait(twin, start(twin, **settings))
    assert made.state == "succeeded", made.message
    said = made.message.partition("; from ")[2]
    took_s = time.perf_counter() - begun_s
    took = f"{took_s:.0f} s ({memory['cpu_s']:.0f} s of computing), {memory['worker']:.0f} MiB in its process"
    if "ended at its deadline" in made.message:
        took += "; the search ended at its deadline with the best so far"
    return [f"{kind} {settings or ''}: {said}", took, target]


def size_MB(path: Path, query: str) -> float:
    """Return what a query of the store sums up, in megabytes."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        return float(connection.execute(query).fetchone()[0] or 0) / 1e6


def answers(url: str, folder: Path) -> list[Row]:
    """Measure default answers and exports."""
    rows = []
    for what in ("telemetry", "residuals"):
        begun_s = time.perf_counter()
        length = len(httpx.get(f"{url}/v1/twins/chain/{what}", timeout=120.0).content)
        took_s = time.perf_counter() - begun_s
        rows.append([f"default answer of {what}", f"{length / 1e6:.1f} MB in {took_s:.1f} s", "bounded"])
    for form in ("csv", "parquet"):
        begun_s = time.perf_counter()
        with most_memory(folder) as memory, stalls(url) as latencies_s:
            length = 0
            with httpx.stream("GET", f"{url}/v1/twins/chain/telemetry/export?format={form}", timeout=600.0) as answer:
                for piece in answer.iter_raw():
                    length += len(piece)
        took_s = time.perf_counter() - begun_s
        stall = f"longest stall {1e3 * max(latencies_s):.0f} ms"
        figures = f"{length / 1e6:.0f} MB in {took_s:.0f} s, server at {memory['server']:.0f} MiB, {stall}"
        rows.append([f"whole archive as {form}", figures, "streamed"])
    return rows


def wide(url: str, folder: Path) -> list[Row]:
    """Measure ingest and calibration of many channels."""
    with TwinClient(url, timeout_s=300.0) as client:
        client.register(chain("wide", N_WIDE))
        begun_s = time.perf_counter()
        post_all(url, "/v1/twins/wide/telemetry", list(frames(WIDE_FRAMES, N_WIDE, 60)), [])
        took_s = time.perf_counter() - begun_s
        what = f"{WIDE_FRAMES:,} frames of {N_WIDE + 1} channels"
        row = job(client, folder, "calibration", "≤ 300 s", "wide")
        return [[f"ingest of {what}", f"{took_s:.0f} s", ""], [f"{what}: {row[0]}", *row[1:]]]


def vast(url: str) -> Row:
    """Measure what a specification of ten thousand nodes, which is refused, and one of two thousand do to others."""
    figures = []
    for count in (10_000, 2000):
        names = [f"T_{k:05d}_of_a_large_spacecraft" for k in range(count)]
        spec = {
            "twin": f"vast-{count}",
            "channels": {name: {"kind": "temperature", "unit": "K"} for name in names},
            "nodes": [{"id": f"n{k}", "sensor": name} for k, name in enumerate(names)],
        }
        with stalls(url) as latencies_s:
            status = httpx.post(f"{url}/v1/twins", json=spec, timeout=120.0).status_code
        figures.append(f"{count:,} nodes: {status}, longest stall {1e3 * max(latencies_s):.0f} ms")
    return ["a vast specification", "; ".join(figures), "no stall of seconds"]


def ingested(url: str, count: int) -> Row:
    """Measure how long so many frames take."""
    begun_s = time.perf_counter()
    post_all(url, "/v1/twins/chain/telemetry", list(frames(count)), [])
    return [f"ingest of {count:,} frames of {N_NODES + 1} channels", f"{time.perf_counter() - begun_s:.0f} s", ""]


def after_activation(client: TwinClient) -> Iterator[Row]:
    """Measure when a model that has just become active forecasts, and when it has seen its window of the archive."""
    begun_s = time.perf_counter()
    ahead = client.forecast("chain", 3600.0, step_s=60.0)
    figures = f"{time.perf_counter() - begun_s:.1f} s, {ahead.behind_s:.0f} s behind"
    yield ["first forecast after the activation", figures, "seconds"]
    while client.twin("chain").catching_up:
        time.sleep(0.5)
    yield ["the window of the archive assimilated", f"{time.perf_counter() - begun_s:.0f} s", ""]


def on_disk(path: Path) -> Row:
    """Measure what samples and residuals take."""
    lengths = {"chunk": "length(seq) + length(time) + length(value) + length(received)"}
    lengths["residual"] = "length(seq) + length(time) + length(value)"
    whole = {table: size_MB(path, f"SELECT sum({sizes}) FROM {table}") for table, sizes in lengths.items()}
    each = {
        table: size_MB(path, f"SELECT 1e6 * sum({sizes}) / sum(n) FROM {table}") for table, sizes in lengths.items()
    }
    figures = ", ".join(f"{whole[table]:.0f} MB ({each[table]:.0f} B a frame)" for table in lengths)
    return ["archive and residuals on disk", figures, "residuals ≤ archive"]


def deleted(url: str, client: TwinClient, path: Path, count: int) -> Row:
    """Measure the deletion of the large twin, and what others notice of it."""
    with stalls(url) as latencies_s:
        begun_s = time.perf_counter()
        client.delete("chain")
        took_s = time.perf_counter() - begun_s
        while size_MB(path, "SELECT 1e6 * count(*) FROM chunk") > 0:
            time.sleep(0.2)
        gone_s = time.perf_counter() - begun_s
    stall_ms = 1e3 * max(latencies_s)
    figures = f"{1e3 * took_s:.0f} ms, gone after {gone_s:.0f} s, longest stall of others {stall_ms:.0f} ms"
    return [f"deletion of the twin of {count:,} frames", figures, "nobody stalls"]


def questions(url: str, folder: Path, count: int, with_diagnosis: bool) -> Iterator[Row]:
    """Yield the rows of the table, one question after the other."""
    path = folder / "bench.sqlite3"
    with TwinClient(url, timeout_s=300.0) as client:
        client.register(chain("chain"))
        yield ingested(url, count)
        yield job(client, folder, "calibration", "≤ 60 s")
        yield from after_activation(client)
        yield job(client, folder, "calibration", "", thin=True, activate=False)
        if with_diagnosis:
            yield job(client, folder, "diagnosis", "≤ 300 s, ≤ 1 GB")
        yield on_disk(path)
        yield from answers(url, folder)
        yield from wide(url, folder)
        yield vast(url)
        client.delete("wide")
        yield deleted(url, client, path, count)


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--without-diagnosis", action="store_true", help="leave out what takes longest")
    parser.add_argument(
        "--only-wide", action="store_true", help="only calibrate the two hundred channels; writes no table"
    )
    given = parser.parse_args()
    load, rows = os.getloadavg()[0], []
    with tempfile.TemporaryDirectory() as name, running(["-m", "service"], Path(name)) as url:
        asked = (
            wide(url, Path(name))
            if given.only_wide
            else questions(url, Path(name), given.frames, not given.without_diagnosis)
        )
        for row in asked:
            print(" | ".join(row), flush=True)
            rows.append(row)
    if given.only_wide:
        return
    table = markdown_table(["what", "measured", "wanted"], rows)
    note = f"Load of the machine before and after: {load:.1f} and {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."
    save_table("service_years", "A large archive", table, "benchmarks.service_years", note)
    print(table)


def chain(twin: str, n_nodes: int = N_NODES) -> dict[str, Any]:
    """Return a twin of so many nodes in a row, each of which has a sensor."""
    life.N_NODES = n_nodes
    return {**life.chain(), "twin": twin}


if __name__ == "__main__":
    main()
