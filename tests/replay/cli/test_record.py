"""``twin record`` against a real server: what arrives is in the file, across a restart, and plays back."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replay.cli.main import main
from replay.mcap_io import read_mcap
from service.client import TwinClient
from tests.service.conftest import SPEC
from tests.service.server import FAKE, Server

pytestmark = pytest.mark.e2e


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with Server(tmp_path, port=str(free_port())) as running:
        running.client().register(SPEC)
        yield running


def free_port() -> int:
    """Return a port that the server can take again after a restart."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def send(client: TwinClient, rows: range) -> None:
    time_s = [60.0 * k for k in rows]
    client.ingest("benchsat", time_s, {"T_px": [290.0 + k for k in rows], "Q_px": [0.5 * k for k in rows]})


def recording(server: Server, out: Path, *more: str) -> "subprocess.Popen[str]":
    """Start a recorder; it says nothing until it ends, so wait until the service counts a reader."""
    argv = ["record", "--url", server.url, "--twin", "benchsat", "--out", str(out), "--json", *more]
    command = [sys.executable, "-m", "replay.cli.main", *argv]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)
    wait_for_reader(server, process)
    return process


def wait_for_reader(server: Server, process: "subprocess.Popen[str]") -> None:
    client = server.client()
    while "twin_stream_readers 1.0" not in client._http.get("/metrics").text:
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


def finish(process: "subprocess.Popen[str]", number: signal.Signals) -> dict[str, Any]:
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    return json.loads(out)


def test_what_arrives_is_recorded_and_plays_back(server: Server, tmp_path: Path) -> None:
    client, out = server.client(), tmp_path / "pass.mcap"
    send(client, range(10))
    process = recording(server, out)
    for first in range(10, 40, 5):
        send(client, range(first, first + 5))
    send(client, range(8, 12))  # known already: nothing new to record
    time.sleep(0.5)
    assert not out.exists()
    outcome = finish(process, signal.SIGINT)
    assert (outcome["samples"], outcome["gaps"], outcome["interruptions"]) == (30, 0, 0)
    found = read_mcap(out)
    assert (found.time_ns // 60_000_000_000).tolist() == list(range(10, 40))
    np.testing.assert_array_equal(found.columns["T_px"], 290.0 + np.arange(10, 40))
    assert found.units == {"T_px": "K", "Q_px": "W"}
    client.register({**SPEC, "twin": "copy"})
    assert main(["replay", str(out), "--url", server.url, "--twin", "copy"]) == 0
    assert client.archive("copy").values == client.archive("benchsat", start=600).values


def test_a_recording_outlives_a_restart_of_the_service(server: Server, tmp_path: Path) -> None:
    out = tmp_path / "pass.mcap"
    process = recording(server, out)
    send(server.client(), range(5))
    server.kill()
    server.start()
    send(server.client(), range(5, 10))
    wait_for_reader(server, process)
    send(server.client(), range(10, 15))
    time.sleep(0.5)
    outcome = finish(process, signal.SIGTERM)
    assert outcome["interruptions"] >= 1
    assert (read_mcap(out).time_ns // 60_000_000_000).tolist() == list(range(15))


def test_a_recorder_that_is_too_slow_takes_the_rest_from_the_archive(tmp_path: Path) -> None:
    with Server(tmp_path, stream_buffer="10") as server:
        client, out = server.client(), tmp_path / "pass.mcap"
        client.register(SPEC)
        process = recording(server, out)
        send(client, range(3))
        send(client, range(3, 3000))
        time.sleep(1.0)
        outcome = finish(process, signal.SIGINT)
        assert outcome["gaps"] >= 1
        assert (read_mcap(out).time_ns // 60_000_000_000).tolist() == list(range(3000))


def test_the_archive_alone(server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    send(server.client(), range(20))
    out = tmp_path / "all.mcap"
    argv = ["record", "--url", server.url, "--twin", "benchsat", "--out", str(out), "--duration", "0"]
    assert main([*argv, "--start", "all"]) == 0
    assert len(read_mcap(out)) == 20
    assert main([*argv, "--start", "1970-01-01T00:10:00Z"]) == 0
    assert len(read_mcap(out)) == 10
    for more, said in (
        (["--twin", "nobody"], "twin 'nobody': 404"),
        (["--out", str(tmp_path / "x.csv")], "must end in .mcap"),
        (["--out", str(tmp_path / "no" / "x.mcap")], "cannot be written"),
        (["--duration", "-1"], "--duration must be"),
        (["--start", "noon"], "start"),
    ):
        assert main([*argv, *more]) == 2
        assert said in capsys.readouterr().err
    assert sorted(path.suffix for path in tmp_path.glob("*.mcap*")) == [".mcap"]


@pytest.mark.parametrize("assimilate", ["true", "false"])
def test_the_archive_comes_with_its_innovations(tmp_path: Path, assimilate: str) -> None:
    with Server(tmp_path, command=FAKE, assimilate=assimilate) as server, server.client() as client:
        client.register(SPEC)
        send(client, range(20))
        model = {"spec": SPEC, "rmse_K": 1.0, "max_step_s": 60.0}
        assert client._http.post("/v1/twins/benchsat/models", json=model).status_code == 201
        client.activate("benchsat", 1)
        out = tmp_path / "all.mcap"
        argv = ["record", "--url", server.url, "--twin", "benchsat", "--out", str(out), "--duration", "0"]
        assert main([*argv, "--start", "1970-01-01T00:10:00Z"]) == 0
        found = read_mcap(out)
        np.testing.assert_array_equal(found.columns["T_px"], 290.0 + np.arange(10, 20))
        if assimilate == "true":
            # The stand-in for the model predicts that nothing changes; the readings rise by one kelvin a minute.
            np.testing.assert_array_equal(found.columns["residual_T_px"], np.ones(10))
            assert found.units["residual_T_px"] == "K"
        else:
            assert np.isnan(found.columns.get("residual_T_px", np.nan)).all()
