"""The page of the control room: each of its commands runs, and its configuration is one."""

import json
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from replay.bridges.config import YamcsConfig
from replay.cli.main import main
from tests.ground.openmct import DIST, NODE
from tests.ground.test_yamcs import feed
from tests.ground.yamcs import Yamcs
from tests.replay.test_convert import GPS_S, SPEC, packet, rows, xtce
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
    (tmp_path / "sat.yaml").write_text(yaml.safe_dump(BENCHSAT))
    monkeypatch.chdir(tmp_path)
    feed(yamcs, 0, 20)
    lines = commands("Yamcs")
    assert [line.split()[:3] for line in lines] == [["twin", "bridge", word] for word in ("xtce", "limits", "yamcs")]
    for line in lines:
        words = shlex.split(line.replace("$YAMCS", yamcs.url))[1:]
        assert main(words + (["--service", service.url] if words[1] != "limits" else [])) == 0, line
    assert "THERMAL_TWIN" in (tmp_path / "thermal-twin.xml").read_text()
    assert service.client().twin("benchsat").samples == 20


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


def test_grafana_finds_its_files(tmp_path: Path) -> None:
    (tmp_path / "conf" / "provisioning").mkdir(parents=True)
    for line in commands("Grafana"):
        subprocess.run(["bash", "-ec", line], cwd=ROOT, env={**os.environ, "GRAFANA": str(tmp_path)}, check=True)
    assert {path.name for path in (tmp_path / "dashboards").iterdir()} == {"twin.json", "fleet.json"}
    assert (tmp_path / "conf" / "provisioning" / "datasources" / "thermal-twin.yaml").exists()


@pytest.mark.ground
@pytest.mark.skipif(shutil.which("promtool") is None, reason="no promtool here: apt-get install prometheus")
def test_prometheus_checks_the_rules() -> None:
    for line in commands("Prometheus"):
        subprocess.run(["bash", "-ec", line], cwd=ROOT, check=True, capture_output=True)


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
