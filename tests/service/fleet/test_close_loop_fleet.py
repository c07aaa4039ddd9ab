"""``twin close-loop --fleet``: a folder per spacecraft, a report each, and one that fails leaves the others alone."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from replay.cli.main import main
from tests.service.fleet.cluster import Cluster

pytestmark = [pytest.mark.fleet, pytest.mark.filterwarnings("ignore")]


def test_a_report_for_each(pair: dict[str, Any], pair_telemetry: Callable[[int], str], tmp_path: Path) -> None:
    fleet, out = tmp_path / "fleet", tmp_path / "out"
    for name in ("alpha", "beta", "empty"):
        folder = fleet / name
        folder.mkdir(parents=True)
        (folder / "spec.yaml").write_text(yaml.safe_dump(pair))
        text = pair_telemetry(240)
        (folder / "flight.csv").write_text("\n".join(text.splitlines()[:8]) + "\n" if name == "empty" else text)
    assert main(["close-loop", "--fleet", str(fleet), "--out", str(out), "--deadline", "200"]) == 0
    found = json.loads((out / "fleet.json").read_text())
    assert sorted(found) == ["alpha", "beta", "empty"] and "error" in found["empty"]
    for name in ("alpha", "beta"):
        report = json.loads((out / name / "report.json").read_text())
        assert report["verdict"] == found[name]["verdict"] == "no_effect_supported"
        assert (out / name / "report.html").is_file() and (out / name / "model.json").is_file()


def test_a_cluster_computes_them(
    pair: dict[str, Any], pair_telemetry: Callable[[int], str], tmp_path: Path, cluster: Cluster
) -> None:
    fleet, out = tmp_path / "fleet", tmp_path / "out"
    for name in ("alpha", "beta"):
        folder = fleet / name
        folder.mkdir(parents=True)
        (folder / "spec.yaml").write_text(yaml.safe_dump(pair))
        (folder / "flight.csv").write_text(pair_telemetry(240))
    place = cluster.address.replace("tcp://", "dask://")
    assert main(["close-loop", "--fleet", str(fleet), "--out", str(out), "--executor", place]) == 0
    found = json.loads((out / "fleet.json").read_text())
    assert {name: one["verdict"] for name, one in found.items()} == dict.fromkeys(
        ("alpha", "beta"), "no_effect_supported"
    )


def test_what_contradicts_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["close-loop", "--out", str(tmp_path / "o")]) == 2
    assert "--fleet" in capsys.readouterr().err
    assert main(["close-loop", "--fleet", str(tmp_path), "--out", str(tmp_path / "o")]) == 2
    assert "holds no folder" in capsys.readouterr().err
    both = [
        "close-loop",
        "--fleet",
        str(tmp_path),
        "--spec",
        "x.yaml",
        "--telemetry",
        "x.csv",
        "--out",
        str(tmp_path / "o"),
    ]
    assert main(both) == 2 and "excludes" in capsys.readouterr().err
