"""How many values per second pass between Yamcs and a twin, and how long a residual is under way.

A real Yamcs server and a real service on this machine. ``python -m benchmarks.yamcs_bridge`` writes
``benchmarks/tables/yamcs_bridge.md``; it needs ``thermal-twin[ground]``.
"""

import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.markdown import markdown_table, save_table
from replay.bridges.config import YamcsConfig
from replay.bridges.yamcs_bridge import YamcsBridge
from replay.bridges.yamcs_gateway import Row, YamcsGateway
from replay.bridges.yamcs_mdb import write_xtce
from replay.bridges.yamcs_names import ISSUED_BY, VERSION
from replay.cli.service_process import running_service
from service.client import TwinClient
from tests.ground.yamcs import Yamcs

T0_MS, STEP_MS = 1_772_323_200_000, 10_000
SINGLE = 200
"""Values set one by one, for comparison."""
PATIENCE_S = 120.0
"""So long is waited for what does not come."""


def specification(n_nodes: int) -> dict[str, Any]:
    """Return a chain of nodes, each with a sensor, the first one heated."""
    nodes = range(n_nodes)
    return {
        "twin": f"chain-{n_nodes}",
        "boundaries": {"space": {"value_K": 2.7}},
        "channels": {f"T{i}": {"kind": "temperature", "unit": "K", "noise_std": 0.05} for i in nodes}
        | {"Q": {"kind": "power", "unit": "W"}},
        "nodes": [{"id": f"n{i}", "sensor": f"T{i}", "capacity_J_per_K": {"guess": 6000.0}} for i in nodes],
        "conductors": [{"between": [f"n{i}", f"n{i + 1}"], "conductance_W_per_K": {"guess": 2.0}} for i in nodes[:-1]],
        "radiators": [{"node": "n0", "emissivity": 0.8, "area_m2": 0.4, "sink": "space"}],
        "loads": [{"channel": "Q", "node": "n0"}],
    }


def telemetry(n_nodes: int, n_times: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (n_times, n_nodes) temperatures in K of the chain, small Euler steps with noise, and its (n_times,) power in W."""
    rng = np.random.default_rng(0)
    power = 120.0 + 60.0 * (np.sin(2.0 * np.pi * np.arange(n_times) * STEP_MS / 5.7e6) > 0)
    state = np.full(n_nodes, 290.0)
    found = np.empty((n_times, n_nodes))
    for k in range(n_times):
        found[k] = state
        for _ in range(2):
            flow = 2.0 * np.diff(state)
            heat = np.zeros(n_nodes)
            heat[:-1] += flow
            heat[1:] -= flow
            heat[0] += power[k] - 5.670374419e-8 * 0.32 * (state[0] ** 4 - 2.7**4)
            state = state + heat / 6000.0 * STEP_MS / 2000.0
    return found + rng.normal(0.0, 0.05, found.shape), power


@contextmanager
def both(n_nodes: int) -> Iterator[tuple[YamcsConfig, Yamcs, TwinClient, str]]:
    """Yield a server of either kind that know each other."""
    from yamcs.pymdb import DataSource, FloatParameter, System

    spec = specification(n_nodes)
    mission = System("SAT")
    for name, channel in spec["channels"].items():
        FloatParameter(mission, name, bits=64, units=channel["unit"], data_source=DataSource.GROUND)
    config = YamcsConfig.model_validate(
        {
            "twin": spec["twin"],
            "parameters": {name: f"/SAT/{name}" for name in spec["channels"]},
            "backfill": {"start": "2026-01-01T00:00:00Z"},
        }
    )
    with tempfile.TemporaryDirectory() as folder, running_service(Path(folder)) as url, TwinClient(url) as client:
        client.register(spec)
        mdb = {"mission.xml": str(mission.dumps()), "twin.xml": write_xtce(config, client.twin(spec["twin"]))}
        with Yamcs(Path(folder) / "yamcs", mdb) as yamcs:
            yield config, yamcs, client, url


def rows_of(found: np.ndarray, power: np.ndarray, first: int, stop: int) -> list[Row]:
    """Return telemetry as rows of Yamcs."""
    names = [f"/SAT/T{i}" for i in range(found.shape[1])]
    return [
        Row(T0_MS + k * STEP_MS, dict(zip(names, found[k].tolist(), strict=True)) | {"/SAT/Q": float(power[k])})
        for k in range(first, stop)
    ]


def single_values_per_s(yamcs: Yamcs) -> float:
    """Return how many values per second pass where each is set by a request of its own."""
    from yamcs.client import YamcsClient

    with closing(YamcsClient(yamcs.url)) as client:
        begun = time.perf_counter()
        for k in range(SINGLE):
            rows = [{"/SAT/Q": _update(float(k), T0_MS - 10_000_000 + k)}]
            client.load_parameter_values("sat", iter(rows), stream="pp_realtime")
        return SINGLE / (time.perf_counter() - begun)


def _update(value: float, time_ms: int) -> Any:
    from yamcs.client import ValueUpdate

    from replay.bridges.instants import to_datetime

    return ValueUpdate(value, generation_time=to_datetime(time_ms))


def measure(n_nodes: int, n_times: int, n_live: int, *, busy: int = 0) -> tuple[list[str], list[str]]:
    """Return one row of the table of rates, and one of that of delays, beside so many processes that never rest."""
    load = os.getloadavg()[0]
    found, power = telemetry(n_nodes, n_times + n_live + 1)
    with both(n_nodes) as (config, yamcs, client, url), YamcsGateway(yamcs.url, "sat") as gateway, beside(busy):
        gateway.publish("pp_realtime", rows_of(found, power, 0, 50))  # Java warms up
        begun = time.perf_counter()
        gateway.publish("pp_realtime", rows_of(found, power, 50, n_times))
        into_yamcs = (n_times - 50) * (n_nodes + 1) / (time.perf_counter() - begun)
        one_by_one = single_values_per_s(yamcs)

        def bridge() -> YamcsBridge:
            return YamcsBridge(config, lambda: YamcsGateway(yamcs.url, "sat"), client, url, lambda _: None, poll_s=0.1)

        begun = time.perf_counter()
        tally = bridge().run(once=True)
        into_twin = tally.accepted * (n_nodes + 1) / (time.perf_counter() - begun)
        job = client.wait(config.twin, client.calibrate(config.twin, samples=300))
        assert job.state == "succeeded", job.message
        while client.twin(config.twin).catching_up:
            time.sleep(0.2)
        begun = time.perf_counter()
        tally = bridge().run(once=True)
        out_of_twin = tally.published_values / (time.perf_counter() - begun)
        residuals, forecasts = live(bridge(), config, gateway, rows_of(found, power, n_times, n_times + n_live + 1))
    case = [str(n_nodes), str(busy), f"{load:.0f}"]
    rates = [*case, *(f"{x:,.0f}" for x in (into_twin, out_of_twin, into_yamcs, one_by_one))]
    return rates, [*case, *_told(residuals, n_live), *_told(forecasts, len(forecasts))]


def _told(delays: Sequence[float], expected: int) -> list[str]:
    found = np.quantile(delays, [0.5, 0.95, 1.0]) if delays else np.full(3, np.nan)
    return [f"{len(delays)} of {expected}", *(f"{1000 * q:.0f}" for q in found)]


@contextmanager
def beside(n: int) -> Iterator[None]:
    """Let so many processes keep a core busy each."""
    spinning = [multiprocessing.Process(target=_spin, daemon=True) for _ in range(n)]
    for process in spinning:
        process.start()
    try:
        yield
    finally:
        for process in spinning:
            process.kill()
            process.join()


def _spin() -> None:
    while True:
        pass


def live(
    bridge: YamcsBridge, config: YamcsConfig, gateway: YamcsGateway, rows: Sequence[Row]
) -> tuple[list[float], list[float]]:
    """Return after how many seconds the residual of each sample stood in Yamcs, and each forecast that a sample led to.

    Samples come at intervals of 0.5 s; before them one waits for the bridge to begin, and does not count. A forecast is that
    of the instant that lies ``lead_s`` behind a sample.
    """
    sent: dict[int, float] = {}
    heard: dict[str, dict[int, float]] = {f"{config.root}/{name}": {} for name in (VERSION, ISSUED_BY)}

    def hear(row: Row) -> None:
        for name in row.values:
            heard[name].setdefault(row.time_ms, time.perf_counter())

    subscription = gateway.subscribe(list(heard), hear)
    thread = threading.Thread(target=bridge.run)
    thread.start()
    residuals, forecasts = heard.values()
    first, *others = rows
    gateway.publish("pp_realtime", [first])
    _until(lambda: first.time_ms in residuals)  # the bridge has begun
    for row in others:
        sent[row.time_ms] = time.perf_counter()
        gateway.publish("pp_realtime", [row])
        time.sleep(0.5)
    _until(lambda: sent.keys() <= residuals.keys())
    bridge.stop()
    thread.join()
    subscription.cancel()
    lead_ms = round(1000 * config.forecast.lead_s)
    led_to = [forecasts[t + lead_ms] - sent[t] for t in sent if t + lead_ms in forecasts]
    return [residuals[t] - sent[t] for t in sent if t in residuals], led_to


def _until(condition: Callable[[], bool]) -> None:
    """Wait until something is so, but not for ever: what is missing then is told by the table."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.05)


def main() -> None:
    """Measure, print and save."""
    results = [measure(n_nodes, 5000, 60) for n_nodes in (1, 2, 10, 20)]
    results.append(measure(10, 5000, 60, busy=2))
    case = ["sensors", "busy processes beside", "load before"]
    rates = markdown_table(
        [
            *case,
            "Yamcs to twin, values/s",
            "twin to Yamcs, values/s",
            "stream alone, values/s",
            "one by one, values/s",
        ],
        [rate for rate, _ in results],
    )
    quantiles = ["median, ms", "95 %, ms", "longest, ms"]
    delays = markdown_table([*case, "residuals", *quantiles, "forecasts", *quantiles], [delay for _, delay in results])
    note = (
        "Rates: the archive of 5000 samples through the bridge into an empty twin (log-in, reading back and health included); "
        "residuals, forecasts and events of all of them back; what the parameter stream takes by itself; the same with one "
        "request per value. Delay: from a sample being sent to Yamcs to its residual being heard from Yamcs, and to the "
        "forecast of the instant one hour behind the sample being heard, through the bridge (`--poll 0.1`), the service's commit "
        "and its filter; one sample every 0.5 s, which is twenty times as fast as its time, so that forecasts are asked for "
        "twenty times as often as in operation. With few sensors the first two rates are mostly the seconds that a connection "
        "takes to begin (checks of every name, reading back). Yamcs, the service, its workers and the bridge share the two "
        "cores; busy processes beside them never rest; the load before is that of other work on the machine, in processes that "
        "would run."
    )
    print(rates, delays, sep="\n")
    save_table("yamcs_bridge", "Yamcs and a twin", rates + "\n" + delays, "benchmarks.yamcs_bridge", note)


if __name__ == "__main__":
    main()
