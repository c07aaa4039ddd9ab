"""What an operator feels: start, forecasts, ingest beside a calibration, memory and plots over a million samples.

``python -m benchmarks.service_life`` measures them with a real server process and writes
``benchmarks/tables/service_life.md``. Targets stand beside the figures; the load of the machine is written down, since a
shared one slows everything.
"""

import argparse
import contextlib
import json
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.markdown import markdown_table, save_table
from benchmarks.service import CHANNELS, bodies, post_all, running, specification
from service.client import TwinClient

N_NODES, N_ORBITS, ORBIT_S, STEP_S = 9, 3, 5700.0, 60.0
MILLION = 1_000_000
SETTLED_S = 15.0
"""Whoever looks at what arrived does so within this time."""
Rows = list[list[str]]


def chain() -> dict[str, Any]:
    """Return a twin of nine nodes in a row, the ends of which radiate."""
    names = [f"n{k}" for k in range(N_NODES)]
    channels: dict[str, Any] = {f"T_{n}": {"kind": "temperature", "unit": "K"} for n in names}
    return {
        "twin": "chain",
        "boundaries": {"space": {"value_K": 2.7}},
        "channels": {**channels, "Q": {"kind": "power", "unit": "W"}},
        "nodes": [{"id": n, "sensor": f"T_{n}", "capacity_J_per_K": {"guess": 8e3}} for n in names],
        "conductors": [{"between": pair, "conductance_W_per_K": {"guess": 2.0}} for pair in pairwise(names)],
        "radiators": [{"node": n, "emissivity": 0.8, "area_m2": 0.3, "sink": "space"} for n in (names[0], names[-1])],
        "loads": [{"channel": "Q", "node": names[0]}],
    }


def orbits(count: int) -> tuple[list[float], dict[str, list[float]]]:
    """Return ``count`` samples of the chain, integrated in steps of two seconds, with noise of 0.05 K."""
    temperature = np.full(N_NODES, 285.0)
    capacity, conductance = 7e3, 2.5
    power = 120.0 + 60.0 * (np.sin(2 * np.pi * np.arange(count) * STEP_S / ORBIT_S) > 0)
    found = np.empty((count, N_NODES))
    for k in range(count):
        found[k] = temperature
        for _ in range(30):
            flow = conductance * np.diff(temperature)
            heat = np.concatenate([flow, [0.0]]) - np.concatenate([[0.0], flow])
            heat[0] += power[k]
            heat[[0, -1]] -= 5.670374419e-8 * 0.24 * temperature[[0, -1]] ** 4
            temperature = temperature + heat / capacity * STEP_S / 30
    found += np.random.default_rng(0).normal(0.0, 0.05, found.shape)
    values = {f"T_n{i}": np.round(found[:, i], 4).tolist() for i in range(N_NODES)}
    return [k * STEP_S for k in range(count)], {**values, "Q": power.tolist()}


def spread_ms(latencies_s: list[float]) -> tuple[float, float]:
    """Return median and 99th percentile in milliseconds."""
    median, last = np.percentile(np.array(latencies_s) * 1e3, [50, 99])
    return float(median), float(last)


def timed(action: Callable[[], object], count: int) -> list[float]:
    """Return how long each of some calls took."""
    found = []
    for _ in range(count):
        begun = time.perf_counter()
        action()
        found.append(time.perf_counter() - begun)
    return found


def start(folder: Path) -> Rows:
    """Measure the time from the command to the first answer."""
    found = []
    for number in range(5):
        (folder / str(number)).mkdir()
        begun = time.perf_counter()
        with running(["-m", "service"], folder / str(number)) as url, TwinClient(url) as client:
            assert client.is_ready()
            found.append(time.perf_counter() - begun)
    return [["start to ready, median of 5", f"{np.median(found):.2f} s", "< 2 s"]]


def forecasts(client: TwinClient, count: int) -> Rows:
    """Measure forecasts of three orbits with quantiles, nothing else going on."""
    client.register(chain())
    client.ingest("chain", *orbits(600))
    job = client.wait("chain", client.calibrate("chain"))
    assert job.state == "succeeded", job.message
    client.all_residuals("chain")
    for _ in range(10):
        client.forecast("chain", N_ORBITS * ORBIT_S, step_s=STEP_S)
    median, last = spread_ms(timed(lambda: client.forecast("chain", N_ORBITS * ORBIT_S, step_s=STEP_S), count))
    return [[f"forecast of {N_ORBITS} orbits, {N_NODES} nodes, 285 points, 3 quantiles: p50, p99",
             f"{median:.1f} ms, {last:.1f} ms", "p99 ≤ 25 ms"]]  # fmt: skip


@contextlib.contextmanager
def calibrating(client: TwinClient, is_on: bool) -> Iterator[threading.Event]:
    """Keep a calibration running; the event is set when it should end."""
    done = threading.Event()

    def work() -> None:
        while not done.is_set():
            job = client.calibrate("chain", activate=False)
            while not client.job("chain", job).done and not done.is_set():
                time.sleep(0.1)
            client.cancel("chain", job)

    thread = threading.Thread(target=work)
    if is_on:
        thread.start()
        time.sleep(3.0)  # until the worker has started and computes
    try:
        yield done
    finally:
        done.set()
        if is_on:
            thread.join()


def beside_a_calibration(url: str, client: TwinClient, requests: int, rounds: int) -> Rows:
    """Measure ingest of 50 frames ten times a second, idle and beside a calibration, taking turns."""
    found: dict[bool, list[float]] = {False: [], True: []}
    lane = 50
    for _ in range(rounds):
        for busy in (False, True):
            with calibrating(client, busy):
                for body in bodies(requests, 50, lane := lane + 1):
                    post_all(url, "/v1/twins/bench/telemetry", [body], found[busy])
                    time.sleep(0.05)
    (_, idle), (_, beside) = spread_ms(found[False]), spread_ms(found[True])
    return [["ingest of 50 frames, p99: idle, beside a calibration, ratio",
             f"{idle:.1f} ms, {beside:.1f} ms, {beside / idle:.1f}", "< 2"]]  # fmt: skip


def memory_MB(folder: Path) -> tuple[float, float]:
    """Return the memory of the server whose database lies in a folder: its own, and the pages of files mapped into it."""
    lock = str(folder / "bench.sqlite3")
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            command = (entry / "cmdline").read_bytes().split(b"\0")
            environment = (entry / "environ").read_bytes()
            if int(entry.name) and b"service" in command and lock.encode() in environment:
                status = (entry / "status").read_text()
                own, mapped = (int(status.split(f"{name}:")[1].split()[0]) / 1024 for name in ("RssAnon", "RssFile"))
                return own, mapped
    raise RuntimeError("no server process found")


def a_million(url: str, client: TwinClient, folder: Path) -> Rows:
    """Measure memory and plots over a million frames."""
    memory = [memory_MB(folder)]
    for lane in range(100, 110):
        post_all(url, "/v1/twins/bench/telemetry", bodies(MILLION // 10_000, 1000, lane), [])
        memory.append(memory_MB(folder))
    time.sleep(SETTLED_S)
    memory.append(memory_MB(folder))
    (own, peak, end), (_, most_mapped, _) = ((m[0], max(m), m[-1]) for m in zip(*memory, strict=True))
    assert client.archive("bench", max_points=2).samples >= MILLION
    whole = spread_ms(timed(lambda: client.archive("bench", max_points=1500), 20))
    times = {"start": 104 * 100_000, "stop": 104 * 100_000 + 50_000}
    part = spread_ms(timed(lambda: client.archive("bench", max_points=1500, **times), 20))
    return [
        [f"memory of the server before {MILLION:,} frames, at most meanwhile, and after them; pages of files mapped, at most",
         f"{own:.0f} MB, {peak:.0f} MB, {end:.0f} MB; {most_mapped:.0f} MB", "flat (within 10 %)"],
        [f"plot of {MILLION:,} samples, {CHANNELS} channels, 1500 points: p50, p99",
         f"{whole[0]:.0f} ms, {whole[1]:.0f} ms", "< 200 ms"],
        ["plot of 50,000 of them", f"{part[0]:.0f} ms, {part[1]:.0f} ms", ""],
    ]  # fmt: skip


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    few = parser.parse_args().quick
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = start(folder)
        with running(["-m", "service"], folder) as url, TwinClient(url) as client:
            post_all(url, "/v1/twins", [json.dumps(specification()).encode()], [])
            rows += forecasts(client, 50 if few else 300)
            rows += beside_a_calibration(url, client, 30 if few else 100, 1 if few else 3)
            rows += a_million(url, client, folder)
    table = markdown_table(["what", "measured", "target"], rows)
    note = f"Load of the machine before and after: {load:.1f} and {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."
    save_table("service_life", "The service over its life", table, "benchmarks.service_life", note)
    print(table)


if __name__ == "__main__":
    main()
