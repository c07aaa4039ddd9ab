"""The page of the control room: each of its commands runs, and its configuration is one."""

import asyncio
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from replay.bridges.config import YamcsConfig
from replay.bridges.foxglove_messages import GRID_TOPIC, LOG_TOPIC
from replay.cli.main import main
from tests.ground.openmct import DIST, NODE
from tests.ground.test_yamcs import feed, published, until
from tests.ground.yamcs import Yamcs
from tests.replay.test_convert import GPS_S, SPEC, packet, rows, xtce
from tests.replay.test_foxglove import heard, messages, viewer
from tests.service.conftest import SPEC as BENCHSAT
from tests.service.server import Server

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "ground.md").read_text()


def section(title: str) -> str:
    found = re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert found is not None, title
    return found[1]


def commands(title: str) -> list[str]:
    """Return the lines of a section's blocks of commands."""
    blocks = re.findall(r"^```sh\n(.*?)^```", section(title), re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line]


def test_the_configuration_is_one() -> None:
    first = re.findall(r"^```yaml\n(.*?)^```", section("Yamcs"), re.MULTILINE | re.DOTALL)[0]
    config = YamcsConfig.model_validate(yaml.safe_load(first))
    assert set(yaml.safe_load(first)) == set(YamcsConfig.model_fields)  # the example shows every field
    assert (
        config.root == YamcsConfig(twin="benchsat", parameters=config.parameters).root
    )  # as the page says of the default


@pytest.mark.ground
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_first_steps_with_yamcs(
    yamcs: Yamcs, service: Server, config_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every command of the section in its order; the server has the XTCE that the third one writes."""
    (tmp_path / "sat.yaml").write_text(yaml.safe_dump(BENCHSAT))
    monkeypatch.chdir(tmp_path)
    client = service.client()
    client.delete("benchsat")
    feed(yamcs, 0, 60)
    *first, once, calibrate, follow = (
        line.replace("$YAMCS", yamcs.url).replace("http://127.0.0.1:8000", service.url) for line in commands("Yamcs")
    )
    assert [line.split()[1] for line in first] == ["bridge", "register", "bridge"]
    elsewhere = ["--service", service.url]
    for line in (*first, once):
        words = shlex.split(line)[1:]
        assert main(words + (elsewhere if words[1] in ("xtce", "yamcs") else [])) == 0, line
    declared = client.twin("benchsat").specification["channels"]["T_px"]["limits"]
    assert declared["red"] == pytest.approx([253.15, 323.15])  # °C of the mission
    assert "THERMAL_TWIN" in (tmp_path / "thermal-twin.xml").read_text()
    assert client.twin("benchsat").samples == 60
    subprocess.run(["bash", "-ec", calibrate], check=True, capture_output=True)
    words = [sys.executable, "-m", "replay.cli.main", *shlex.split(follow)[1:], *elsewhere]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            until(lambda: len(published(yamcs, "T_px/residual")) == 60, "residuals are there")
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0 and process.stdout is not None
        assert "residual_rows 60" in process.stdout.read()


def test_files_are_converted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sat.yaml").write_text(yaml.safe_dump(SPEC))
    (tmp_path / "export.csv").write_text("Time\t/SAT/T_a\t/SAT/Q_a\n2026-03-01T00:00:00Z\t20\t1500\n")
    frames = [packet(k, GPS_S + k, 12_000, 1.5) for k in range(3)]
    (tmp_path / "tm.bin").write_bytes(b"".join(frames))
    heard = [{"timestamp": f"2026-03-01T00:00:0{k}Z", "frame": frame.hex()} for k, frame in enumerate(frames)]
    (tmp_path / "frames.json").write_text(json.dumps(heard))
    xtce(tmp_path)
    monkeypatch.chdir(tmp_path)
    lines = commands("Files")
    assert len(lines) == 3
    for line in lines:
        assert main(shlex.split(line)[1:]) == 0, line
    assert [float(row["T_a"]) for row in rows(tmp_path / "telemetry.csv")] == pytest.approx([293.15] * 3)


@pytest.mark.e2e
def test_foxglove_is_served_and_recorded(service: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer that speaks Foxglove's protocol hears what is ingested after it subscribed, and what happened before."""
    pytest.importorskip("foxglove")
    simulate, record, serve = (
        line.replace("examples/", f"{ROOT}/examples/").replace("http://127.0.0.1:8000", service.url)
        for line in commands("Foxglove")
    )
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(simulate)[1:]) == 0
    assert len(messages(tmp_path / "orbits.mcap", GRID_TOPIC)) == 77  # 45600 s, and the beginning
    client = service.client()
    times = [1_772_323_200.0 + 60.0 * k for k in range(40)]
    client.ingest("benchsat", times, {"T_px": [290.0] * 40, "Q_px": [40.0] * 40})
    client.wait("benchsat", client.calibrate("benchsat"))
    assert main(shlex.split(record)[1:]) == 0
    told = [body["message"] for body, _ in messages(tmp_path / "pass.mcap", LOG_TOPIC)]
    assert told == ["model version 1 is active: the first model"]

    words = [sys.executable, "-m", "replay.cli.main", *shlex.split(serve.replace("--port 8765", "--port 0"))[1:]]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().removeprefix("listening on ").strip()

            async def watch() -> None:
                async with viewer(url, ["T_px", LOG_TOPIC]) as (socket, ids, _):
                    assert [body["message"] for _, _, body in await heard(socket, ids, 1)] == told
                    await asyncio.to_thread(client.ingest, "benchsat", [1_772_330_000.5], {"T_px": [301.25]})
                    assert await heard(socket, ids, 1) == [("T_px", 1_772_330_000_500_000_000, {"value": 301.25})]

            asyncio.run(watch())
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


def test_grafana_finds_its_files(tmp_path: Path) -> None:
    (tmp_path / "conf" / "provisioning").mkdir(parents=True)
    for line in commands("Grafana"):
        subprocess.run(["bash", "-ec", line], cwd=ROOT, env={**os.environ, "GRAFANA": str(tmp_path)}, check=True)
    assert {path.name for path in (tmp_path / "dashboards").iterdir()} == {"twin.json", "fleet.json"}
    assert (tmp_path / "conf" / "provisioning" / "datasources" / "thermal-twin.yaml").exists()


@pytest.mark.ground
@pytest.mark.skipif(shutil.which("promtool") is None, reason="no promtool here: apt-get install prometheus")
def test_prometheus_checks_the_rules() -> None:
    (line,) = commands("Prometheus")
    done = subprocess.run(["bash", "-ec", line], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "SUCCESS" in done.stdout, done.stderr


@pytest.mark.ground
@pytest.mark.skipif(NODE is None or not DIST.exists(), reason="no Open MCT here: make test-ground installs it")
def test_open_mct_is_served(tmp_path: Path) -> None:
    """``npm install openmct`` is what ``make test-ground`` does; the server finds it from where it is started."""
    install, serve = commands("Open MCT")
    assert install == "npm install openmct"
    words = shlex.split(serve.replace("--port 8081", "--port 0").replace("replay/", f"{ROOT}/replay/"))
    process = subprocess.Popen(words, cwd=DIST.parents[2], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert process.stdout.readline().startswith("listening on http://127.0.0.1:")
    finally:
        process.terminate()
        process.wait(20)
        process.stdout.close()
