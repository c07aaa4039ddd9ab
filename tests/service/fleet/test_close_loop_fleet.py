"""``twin close-loop --fleet``: a folder per spacecraft, a report each, and one that fails leaves the others alone."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from replay.cli.main import main
from tests.service.fleet.cluster import Cluster

pytestmark = [pytest.mark.fleet, pytest.mark.filterwarnings("ignore")]


def test_a_report_for_each_that_has_one_and_a_line_for_the_others(
    pair: dict[str, Any], pair_telemetry: Callable[[int], str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet = tmp_path / "fleet"
    out = fleet / "out"  # beside the spacecraft, of which it is none
    out.mkdir(parents=True)
    (fleet / ".hidden").mkdir()
    for name in ("alpha", "beta", "empty"):
        folder = fleet / name
        folder.mkdir(parents=True)
        (folder / "spec.yaml").write_text(yaml.safe_dump(pair))
        text = pair_telemetry(240)
        (folder / "flight.csv").write_text("\n".join(text.splitlines()[:8]) + "\n" if name == "empty" else text)
    for name, spec, text in (("bare", None, "time\n"), ("silent", pair, None), ("torn", pair, "time,T_a\nx,y\n")):
        (fleet / name).mkdir()
        if spec is not None:
            (fleet / name / "spec.yaml").write_text(yaml.safe_dump(spec))
        if text is not None:
            (fleet / name / "flight.csv").write_text(text)
    (fleet / "wrong").mkdir()
    (fleet / "wrong" / "spec.yaml").write_text("twin: [\n")
    (fleet / "wrong" / "flight.csv").write_text("time\n")
    assert main(["close-loop", "--fleet", str(fleet), "--out", str(out), "--deadline", "200"]) == 2
    found = json.loads((out / "fleet.json").read_text())
    failed = ["bare", "empty", "silent", "torn", "wrong"]
    assert sorted(found) == sorted(["alpha", "beta", *failed])
    assert [name for name in sorted(found) if "error" in found[name]] == failed
    told = capsys.readouterr()
    lines = told.err.splitlines()
    assert [line.partition(":")[0] for line in lines[:-1]] == failed
    assert lines[-1] == "twin: 5 of 7 spacecraft failed: bare, empty, silent, torn, wrong"
    assert all(name in told.out for name in found)
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


def test_a_cluster_that_is_not_there_is_told_in_one_line(
    pair: dict[str, Any], pair_telemetry: Callable[[int], str], tmp_path: Path
) -> None:
    folder = tmp_path / "fleet" / "alpha"
    folder.mkdir(parents=True)
    (folder / "spec.yaml").write_text(yaml.safe_dump(pair))
    (folder / "flight.csv").write_text(pair_telemetry(240))
    for place, said in (
        ("dask://127.0.0.1:1", "--executor dask://127.0.0.1:1: no scheduler of Dask answers there"),
        ("dask://127.0.0.1", "--executor must be process or dask://HOST:PORT (got dask://127.0.0.1)"),
    ):
        command = ["close-loop", "--fleet", str(folder.parent), "--out", str(tmp_path / "out"), "--executor", place]
        ended = subprocess.run(
            [sys.executable, "-m", "replay.cli.main", *command], capture_output=True, text=True, timeout=120
        )
        assert ended.returncode == 2 and said in ended.stderr and ended.stderr.count("\n") == 1, ended.stderr


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
