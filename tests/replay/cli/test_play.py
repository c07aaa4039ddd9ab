"""``twin replay`` and ``twin serve`` as real processes talking HTTP."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replay.cli.main import main
from replay.cli.service_process import running_service
from replay.mcap_io import write_mcap
from service.client import TwinClient

EPOCH_NS = 1_767_225_600_000_000_000
pytestmark = pytest.mark.e2e


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory, pair_declared: dict[str, Any]) -> Iterator[str]:
    with running_service(tmp_path_factory.mktemp("service")) as address, TwinClient(address) as client:
        client.register(pair_declared)
        yield address


def record(path: Path, rows: range, warmer_K: float = 0.0) -> Path:
    """Write a recording of another tool: its own topics, temperature a in kelvin."""
    time_s = np.array(rows, dtype=np.int64) * 60
    columns = {"/bus/T_a": 280.0 + warmer_K + time_s / 100, "heat": np.full(time_s.size, 5.0)}
    write_mcap(path, EPOCH_NS + time_s * 10**9, columns, {"/bus/T_a": "K", "heat": "W"})
    return path


def run(capsys: pytest.CaptureFixture[str], url: str, path: Path, *more: str) -> tuple[int, Any]:
    code = main(["replay", str(path), "--url", url, "--twin", "pair", "--map", "heat=Q_a", "--json", *more])
    printed = capsys.readouterr()
    return code, json.loads(printed.out) if printed.out else printed.err


def test_samples_arrive_once(url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, whole = record(tmp_path / "first.mcap", range(30)), record(tmp_path / "whole.mcap", range(40))
    code, outcome = run(capsys, url, first)
    assert code == 0 and outcome["accepted"] == 30 and outcome["last_time"].startswith("2026-01-01T00:29:00")
    code, outcome = run(capsys, url, first)
    assert code == 0 and (outcome["accepted"], outcome["duplicates"]) == (0, 30)
    code, outcome = run(capsys, url, whole, "--resume")
    assert code == 0 and (outcome["sent"], outcome["accepted"]) == (10, 10)
    with TwinClient(url) as client:
        archive = client.archive("pair", channels=["T_a", "Q_a"])
    # Kelvin in the recording, degrees Celsius in the twin.
    np.testing.assert_allclose(archive.values["T_a"], 280.0 - 273.15 + np.arange(40) * 0.6)
    assert archive.values["Q_a"] == [5.0] * 40
    earlier = record(tmp_path / "earlier.mcap", range(-20, 45))
    code, outcome = run(capsys, url, earlier, "--resume")
    assert code == 0 and (outcome["sent"], outcome["accepted"]) == (25, 25)


def test_conflicts_are_the_answer_no(url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(capsys, url, record(tmp_path / "a.mcap", range(5)))
    code, outcome = run(capsys, url, record(tmp_path / "b.mcap", range(5), warmer_K=1.0))
    assert code == 1 and outcome["rejected"] == 5


def test_samples_ahead_of_the_services_clock_are_told(
    url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, url, record(tmp_path / "a.mcap", range(40)))
    century = 100 * 365 * 24 * 60
    code, outcome = run(capsys, url, record(tmp_path / "b.mcap", range(century, century + 3), warmer_K=-century * 0.6))
    assert code == 1 and (outcome["accepted"], outcome["quarantined"]) == (0, 3)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--twin", "nobody"], "twin 'nobody': 404"),
        (["--map", "heat=Q_z"], "unknown channel 'Q_z'"),
        (["--map", "cold=Q_a"], "unknown topic 'cold'"),
        (["--map", "heat=T_b"], "channel 'T_b' is in W, the specification says K"),
    ],
)
def test_what_does_not_fit(
    url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    path = record(tmp_path / "a.mcap", range(5))
    assert main(["replay", str(path), "--url", url, "--twin", "pair", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_serve_announces_itself_and_ends_in_good_order(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "replay.cli.main", "serve", "--port", "0"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        address = process.stdout.readline().removeprefix("listening on ").strip()
        with TwinClient(address) as client:
            assert client.is_ready()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    assert "Traceback" not in said
