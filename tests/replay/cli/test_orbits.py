"""Finite-element orbits replayed into a real server that is killed in the middle, by a replayer that is killed too."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from replay.cli.recordings import save_record
from service.client import TwinClient, Unreachable
from tests.replay.cli.test_record import free_port
from tests.service.server import Server
from twin_core.fem.demo import ORBIT_S, demo_scenario
from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import simulate
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec
from twin_core.telemetry import Record

pytestmark = [pytest.mark.e2e, pytest.mark.slow]


@dataclass(frozen=True)
class Orbits:
    """Four orbits of the demonstration's spacecraft, and the file that holds them."""

    spec: TwinSpec
    record: Record
    file: Path


@pytest.fixture(scope="module")
def orbits(tmp_path_factory: pytest.TempPathFactory) -> Orbits:
    scenario, spec = demo_scenario("none", 5)
    body = scenario.model_dump(mode="json", exclude_none=True)
    body["time"] |= {"duration_s": 4.0 * ORBIT_S, "settle_s": ORBIT_S}
    record = simulate(load_scenario(body)).record
    path = tmp_path_factory.mktemp("orbits") / "orbits.mcap"
    save_record(path, record, {name: channel.unit for name, channel in scenario.channels.items()}, {})
    return Orbits(spec, record, path)


@pytest.fixture
def server(tmp_path: Path, orbits: Orbits) -> Iterator[Server]:
    with Server(tmp_path, port=str(free_port())) as running:
        running.client().register(dump_spec(orbits.spec))
        yield running


def replaying(server: Server, orbits: Orbits, *more: str) -> "subprocess.Popen[str]":
    argv = ["replay", str(orbits.file), "--url", server.url, "--twin", orbits.spec.twin, "--json", *more]
    command = [sys.executable, "-m", "replay.cli.main", *argv]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)


def wait_for(client: TwinClient, twin: str, count: int) -> None:
    deadline_s = time.monotonic() + 60.0
    while client.twin(twin).samples < count:
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def test_orbits_arrive_once_whoever_is_killed_in_the_middle(server: Server, orbits: Orbits) -> None:
    twin, total = orbits.spec.twin, orbits.record.time_s.size
    first = replaying(server, orbits, "--rate", "3000")  # 7.6 s for all orbits
    wait_for(server.client(), twin, total // 5)
    first.send_signal(signal.SIGKILL)
    first.communicate()
    second = replaying(server, orbits, "--rate", "3000", "--resume")
    held = server.client().twin(twin).samples
    wait_for(server.client(), twin, max(held, total // 2))
    server.kill()
    time.sleep(0.5)
    with pytest.raises(Unreachable):
        server.client().twins()
    server.start()
    out, err = second.communicate(timeout=90)
    assert second.returncode == 0, err
    assert json.loads(out)["rejected"] == 0
    client = server.client()
    archive = client.archive(twin)
    assert archive.samples == client.twin(twin).samples == total
    for name in orbits.spec.sensors:
        np.testing.assert_allclose(archive.values[name], orbits.record.values[name], atol=1e-9)
    _look(client, orbits)


def _look(client: TwinClient, orbits: Orbits) -> None:
    """Calibrate on what arrived; residuals are noise and the forecast goes on from the last reading."""
    twin = orbits.spec.twin
    job = client.wait(twin, client.calibrate(twin))
    assert job.state == "succeeded", job.message
    residuals = client.all_residuals(twin)
    assert residuals.complete and residuals.samples == orbits.record.time_s.size
    for name in orbits.spec.sensors:
        later = np.array(residuals.residual_K[name][60:], dtype=float)
        assert np.sqrt(np.mean(later**2)) < 0.16  # twice the sensors' noise
    ahead = client.forecast(twin, 600.0, step_s=60.0)
    for name in orbits.spec.sensors:
        assert abs(ahead.values[name]["mean"][0] - orbits.record.values[name][-1]) < 2.0
