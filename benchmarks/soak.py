"""A soak: many twins at one frame a second, with wrong clocks, frozen sensors, kills and jobs, against a real server process.

At the end every acknowledged frame must be in the archive, every forecast must have been from the present or have said that it
is not, 85 to 95 % of what came must lie in the forecasts' 90 % bands, and the server's memory must be flat: in the last minutes
nobody kills it, while everything else goes on.
``python -m benchmarks.soak [--minutes 60] [--twins 50] [--kill-every-min 5] [--calm-min 15]`` writes
``benchmarks/tables/soak.md``; exit status 1 if any of that failed.
"""

import argparse
import contextlib
import csv
import io
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.markdown import markdown_table, save_table
from service.client import ApiError, Retry, TwinClient, Unreachable

SENSORS, HISTORY_S, HORIZON_S, STEP_S = 3, 1800, 120, 10
PERIOD_S, NOISE_K = 300, 0.05
FRESH_S = 15.0
"""A forecast is of the present if its state is at most so much older than the newest frame acknowledged when it was asked for."""
LANES = 4
WARM_UP_S = 540.0
"""A process counts as warm so long after its start; what it needs then is compared with what it needs at the end. Each twin's
stream keeps ``hub.IN_MEMORY`` messages, two for each frame: at one frame a second they are there after 500 s."""
GROWTH = 1.1
Row = list[str]


def specification(name: str) -> dict[str, Any]:
    """Return three nodes in a row, heated at one end, radiating at both."""
    nodes = [f"n{k}" for k in range(SENSORS)]
    channels: dict[str, Any] = {f"T_{n}": {"kind": "temperature", "unit": "K"} for n in nodes}
    return {
        "twin": name,
        "boundaries": {"space": {"value_K": 2.7}},
        "channels": {**channels, "Q": {"kind": "power", "unit": "W"}},
        "nodes": [{"id": n, "sensor": f"T_{n}", "capacity_J_per_K": {"guess": 350.0}} for n in nodes],
        "conductors": [{"between": [a, b], "conductance_W_per_K": {"guess": 1.5}} for a, b in pairwise(nodes)],
        "radiators": [{"node": n, "emissivity": 0.8, "area_m2": 0.09, "sink": "space"} for n in (nodes[0], nodes[-1])],
        "loads": [{"channel": "Q", "node": nodes[0]}],
    }


def world(twins: int, length_s: int) -> tuple[np.ndarray, np.ndarray]:
    """Return readings (length_s, twins, sensors) with noise and powers (length_s, twins), a second apart."""
    generator = np.random.default_rng(0)
    second = np.arange(length_s)[:, None]
    phase = generator.integers(0, PERIOD_S, twins)[None, :]
    power = np.where((second + phase) % PERIOD_S < PERIOD_S // 2, 90.0, 30.0)
    temperature = np.full((twins, SENSORS), 288.0)
    found = np.empty((length_s, twins, SENSORS))
    for k in range(length_s):
        found[k] = temperature
        for _ in range(4):
            flow = 2.0 * np.diff(temperature, axis=1)
            heat = np.pad(flow, ((0, 0), (0, 1))) - np.pad(flow, ((0, 0), (1, 0)))
            heat[:, 0] += power[k]
            heat[:, [0, -1]] -= 5.670374419e-8 * 0.8 * 0.09 * temperature[:, [0, -1]] ** 4
            temperature = temperature + heat / 400.0 / 4
    return np.round(found + generator.normal(0.0, NOISE_K, found.shape), 3), power


class Server:
    """A server process that is killed and started again on the same port and file."""

    def __init__(self, folder: Path) -> None:
        """Choose a free port."""
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.url, self._folder, self.kills = f"http://127.0.0.1:{self.port}", folder, 0
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start it and wait until it answers."""
        own = {"TWIN_PORT": str(self.port), "TWIN_DATABASE_URL": f"sqlite:///{self._folder / 'soak.sqlite3'}"}
        with (self._folder / "server.log").open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "service"],
                env={**os.environ, **own},
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        assert self.process.stdout is not None
        assert self.process.stdout.readline().startswith("listening"), "the server does not start"

    def kill(self) -> None:
        """Kill it as a power cut would, and start it again."""
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self.kills += 1
        self.start()

    def stop(self) -> None:
        """End it in good order."""
        if self.process is not None:
            self.process.terminate()
            self.process.wait()

    def memory_MB(self) -> float:
        """Return the memory of the server's process: its own, without the pages of files that the kernel takes back."""
        assert self.process is not None
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.split("RssAnon:")[1].split()[0]) / 1024


@dataclass
class Tally:
    """What happened; ``acknowledged`` counts frames of each twin, ``asked`` holds (twin, instant, low, high) of forecasts."""

    acknowledged: list[int]
    faults: dict[str, int] = field(default_factory=dict)
    asked: list[tuple[int, int, np.ndarray, np.ndarray]] = field(default_factory=list)
    fresh: int = 0
    told: int = 0
    refused: int = 0
    silent: list[str] = field(default_factory=list)
    memory_MB: list[tuple[float, float]] = field(default_factory=list)
    jobs: dict[str, int] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    load: list[float] = field(default_factory=list)

    def note(self, what: str) -> None:
        """Count a fault."""
        self.faults[what] = self.faults.get(what, 0) + 1


class Soak:
    """One run; ``start_s`` is the unix second of index 0 of the world."""

    def __init__(self, twins: int, minutes: float, kill_every_s: float, calm_s: float, folder: Path) -> None:
        """Make the world for the whole run: some minutes with kills, and a calm stretch at the end."""
        self.n, self.length_s, self.calm_s = twins, int(60 * minutes + calm_s), calm_s
        self.readings, self.power = world(twins, HISTORY_S + self.length_s + 2 * HORIZON_S)
        self.server, self.kill_every_s = Server(folder), kill_every_s
        self.tally = Tally([0] * twins)
        self.done = threading.Event()
        self.frozen: list[list[tuple[int, int, int]]] = [[] for _ in range(twins)]
        """Of each twin, sensors with the index at which they froze and the one at which they went on."""
        self.names = [f"soak-{k}" for k in range(twins)]

    def columns(self, twin: int, first: int, stop: int) -> dict[str, list[float]]:
        """Return the frames of one twin; a sensor that is frozen repeats one reading."""
        made = {f"T_n{s}": self.readings[first:stop, twin, s].tolist() for s in range(SENSORS)}
        for sensor, since, until in self.frozen[twin]:
            for k in range(max(first, since), min(stop, until)):
                made[f"T_n{sensor}"][k - first] = float(self.readings[since, twin, sensor])
        return made | {"Q": self.power[first:stop, twin].tolist()}

    def prepare(self, client: TwinClient) -> None:
        """Register every twin with its past, calibrate the first one and give its model to all."""
        self.start_s = int(time.time()) - HISTORY_S
        for k, name in enumerate(self.names):
            client.register(specification(name))
            client.ingest(name, [self.start_s + i for i in range(HISTORY_S)], self.columns(k, 0, HISTORY_S))
            self.tally.acknowledged[k] = HISTORY_S
        job = client.wait(self.names[0], client.calibrate(self.names[0]))
        assert job.state == "succeeded", job.message
        document = client.model(self.names[0], 1).model
        for name in self.names[1:]:
            document["spec"]["twin"] = name
            made = client._http.post(f"/v1/twins/{name}/models", json=document)
            assert made.status_code == 201, made.text
            client.activate(name, made.json()["version"])

    def send(self, lane: int) -> None:
        """Send what is due of some twins, again and again until it is acknowledged."""
        with TwinClient(self.server.url, retry=Retry(attempts=1), timeout_s=20.0) as client:
            while not self.done.is_set():
                begun_s = time.time()
                for k in range(lane, self.n, LANES):
                    first, stop = (
                        self.tally.acknowledged[k],
                        min(int(time.time()) - self.start_s, HISTORY_S + self.length_s),
                    )
                    stop = min(stop, first + 500)
                    if stop <= first:
                        continue
                    try:
                        report = client.ingest(
                            self.names[k], [self.start_s + i for i in range(first, stop)], self.columns(k, first, stop)
                        )
                    except Unreachable:
                        continue
                    except ApiError as error:
                        self.tally.errors.append(f"ingest: {error}")
                        continue
                    if report.rejected or report.accepted + report.duplicates != stop - first:
                        self.tally.errors.append(f"ingest of {self.names[k]}: {report}")
                    self.tally.acknowledged[k] = stop
                time.sleep(max(0.0, 1.0 - (time.time() - begun_s)))

    def watched(self, task: Callable[[], None]) -> None:
        """Do a task; what ends it early is an error of the run."""
        try:
            task()
        except Exception as error:
            self.tally.errors.append(f"{type(error).__name__}: {error}")

    def ask(self) -> None:
        """Ask one twin after another for a forecast, and keep what it promises."""
        turn = 0
        with TwinClient(self.server.url, retry=Retry(attempts=1), timeout_s=30.0) as client:
            while not self.done.is_set():
                k, turn = turn % self.n, turn + 7
                known_s = self.start_s + self.tally.acknowledged[k] - 1
                try:
                    ahead = client.forecast(self.names[k], HORIZON_S, step_s=STEP_S)
                except Unreachable:
                    time.sleep(0.5)
                    continue
                except ApiError as error:
                    self.tally.refused += error.status == 409
                    if error.status != 409:
                        self.tally.errors.append(f"forecast: {error}")
                    time.sleep(0.5)
                    continue
                began_s = datetime.fromisoformat(ahead.from_ or "").timestamp()
                if known_s - began_s <= FRESH_S:
                    self.tally.fresh += 1
                    low, high = (
                        np.array([ahead.values[f"T_n{s}"][q] for s in range(SENSORS)]).T for q in ("q05", "q95")
                    )
                    self.tally.asked.append((k, round(began_s) - self.start_s, low, high))
                elif ahead.behind_s > 0 and ahead.notices:
                    self.tally.told += 1
                else:
                    self.tally.silent.append(f"{self.names[k]}: {known_s - began_s:.0f} s old, notices {ahead.notices}")
                time.sleep(0.4)

    def harm(self) -> None:
        """Let clocks go wrong and sensors freeze, and keep a job running."""
        generator = np.random.default_rng(1)
        with TwinClient(self.server.url, retry=Retry(attempts=1), timeout_s=30.0) as client:
            job: tuple[str, Any] | None = None
            while not self.done.wait(5.0):
                k = int(generator.integers(self.n))
                with contextlib.suppress(Unreachable, ApiError):
                    ahead_d = float(generator.choice([5.0, 200.0]))
                    report = client.ingest(self.names[k], [time.time() + 86_400 * ahead_d], {"T_n0": [250.0]})
                    self.tally.note("frames of a wrong clock")
                    if not report.quarantined:
                        self.tally.errors.append(
                            f"a frame {ahead_d:g} days ahead went into the archive of {self.names[k]}"
                        )
                other, now = int(generator.integers(self.n)), int(time.time()) - self.start_s
                if generator.random() < 0.15 and (not self.frozen[other] or self.frozen[other][-1][2] < now - 60):
                    self.frozen[other].append((int(generator.integers(SENSORS)), now + 5, now + 65))
                    self.tally.note("sensors that froze for a minute")
                with contextlib.suppress(Unreachable, ApiError):
                    if job is None:
                        name = self.names[int(generator.integers(self.n))]
                        job = (name, client.calibrate(name, activate=False))
                    elif (state := client.job(*job)).done:
                        ended = state.state
                        if ended == "failed" and state.message.startswith("interrupted"):
                            ended = "interrupted by a kill"
                        elif ended == "failed":
                            self.tally.errors.append(f"a job of {job[0]} failed: {state.message}")
                        self.tally.jobs[ended] = self.tally.jobs.get(ended, 0) + 1
                        job = None

    def run(self) -> None:
        """Run for the whole time, killing the server now and then."""
        self.server.start()
        try:
            with TwinClient(self.server.url, timeout_s=60.0) as client:
                self.prepare(client)
            tasks = [*(partial(self.send, lane) for lane in range(LANES)), self.ask, self.harm]
            workers = [threading.Thread(target=self.watched, args=(task,)) for task in tasks]
            begun_s = killed_s = time.monotonic()
            for worker in workers:
                worker.start()
            while (now_s := time.monotonic()) < begun_s + self.length_s:
                time.sleep(2.0)
                self.tally.load.append(os.getloadavg()[0])
                self.tally.memory_MB.append((now_s - killed_s, self.server.memory_MB()))
                if now_s - killed_s >= self.kill_every_s and now_s < begun_s + self.length_s - self.calm_s - 30:
                    self.server.kill()
                    killed_s = time.monotonic()
            time.sleep(5.0)  # what was sent last is assimilated
            self.done.set()
            for worker in workers:
                worker.join()
            self.lost = self.count_lost()
        finally:
            self.done.set()
            self.server.stop()

    def count_lost(self) -> int:
        """Return how many acknowledged frames are not in the archive as they were sent."""
        lost = 0
        for k, name in enumerate(self.names):
            answer = httpx.get(f"{self.server.url}/v1/twins/{name}/telemetry/export", timeout=120.0)
            rows = list(csv.reader(io.StringIO(answer.text)))
            there = {round(datetime.fromisoformat(row[0]).timestamp()): row[1:] for row in rows[1:]}
            for i in range(self.tally.acknowledged[k]):
                cells = there.get(self.start_s + i)
                lost += cells is None or float(cells[-1]) != self.power[i, k]
        return lost

    def covered(self) -> tuple[float, int]:
        """Return the share of readings that lay in the bands of forecasts, and how many there were; frozen ones do not count."""
        inside: list[np.ndarray] = []
        for k, began, low, high in self.tally.asked:
            place = began + STEP_S * np.arange(1, low.shape[0] + 1)
            real = self.readings[place, k]
            harmed = any(since - HORIZON_S < began < until + HORIZON_S for _, since, until in self.frozen[k])
            if not harmed:  # otherwise the state knew of a frozen sensor, or the future held one
                inside.append((real >= low) & (real <= high))
        every = np.concatenate(inside) if inside else np.zeros(0, dtype=np.bool_)
        return float(every.mean()) if every.size else float("nan"), int(every.size)

    def memory_MB(self) -> tuple[float, float, float]:
        """Return the last process's memory: medians of a minute once it was warm and of its last minute; and the peak of all."""
        looks = self.tally.memory_MB
        last = looks[max((i for i in range(1, len(looks)) if looks[i][0] < looks[i - 1][0]), default=0) :]
        warm = [memory for age_s, memory in last if WARM_UP_S <= age_s < WARM_UP_S + 60.0]
        ends = [memory for age_s, memory in last if age_s >= last[-1][0] - 60.0]
        if not warm:
            return float("nan"), float("nan"), float("nan")
        return float(np.median(warm)), float(np.median(ends)), max(memory for _, memory in looks)

    def rows(self) -> tuple[list[Row], bool]:
        """Return the table, and whether everything held."""
        t = self.tally
        coverage, n_readings = self.covered()
        warm_MB, end_MB, peak_MB = self.memory_MB()
        checks = [
            self.lost == 0 and not t.errors,
            not t.silent and t.fresh > 0,
            0.85 <= coverage <= 0.95,
            end_MB <= GROWTH * warm_MB,
        ]
        told = [
            ["length, twins, frames acknowledged",
             f"{self.length_s / 60:g} min ({self.calm_s / 60:g} of them without kills), {self.n}, {sum(t.acknowledged):,}", ""],
            ["kills, " + ", ".join(t.faults), ", ".join(map(str, [self.server.kills, *t.faults.values()])), ""],
            ["jobs beside it", ", ".join(f"{n} {state}" for state, n in t.jobs.items()) or "none ended", ""],
            ["acknowledged frames that are missing; errors", f"{self.lost}; {len(t.errors)}", "0; 0"],
            ["forecasts from the present, told otherwise, refused with a reason, neither",
             f"{t.fresh}, {t.told}, {t.refused}, {len(t.silent)}", "neither: 0"],
            [f"readings within the 90 % bands, of {n_readings:,}", f"{coverage:.1%}", "85 to 95 %"],
            [f"memory of the server in the last {self.calm_s / 60:g} min: once warm, at the end; peak of all processes",
             f"{warm_MB:.0f} MB, {end_MB:.0f} MB; {peak_MB:.0f} MB", f"flat (within {GROWTH - 1:.0%})"],
        ]  # fmt: skip
        return told, all(checks)


def main() -> int:
    """Run the soak from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--twins", type=int, default=50)
    parser.add_argument("--kill-every-min", type=float, default=5.0)
    parser.add_argument("--calm-min", type=float, default=15.0, help="at the end, without kills")
    parser.add_argument("--json", action="store_true", help="print what went wrong, too")
    given = parser.parse_args()
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        soak = Soak(given.twins, given.minutes, 60 * given.kill_every_min, 60 * given.calm_min, Path(name))
        soak.run()
        rows, is_well = soak.rows()
    table = markdown_table(["what", "measured", "wanted"], rows)
    note = (
        f"Load of the machine: {before:.1f} before; {np.mean(soak.tally.load):.1f} on average and {max(soak.tally.load):.1f} "
        f"at most meanwhile, on {os.cpu_count()} cores."
    )
    save_table("soak", "A soak of the service", table, "benchmarks.soak", note)
    print(table)
    if given.json:
        wrong = {"errors": soak.tally.errors[:20], "silent": soak.tally.silent[:20]}
        print(json.dumps(wrong | {"memory_MB": soak.tally.memory_MB[::15]}, indent=1))
    return 0 if is_well else 1


if __name__ == "__main__":
    sys.exit(main())
