"""The first hour: drafting a specification, checking it, showing a model; durations and completion."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import yaml

from replay.cli.durations import DURATION
from replay.cli.main import main
from twin_core.network.spec_io import load_spec

ROOT = Path(__file__).parents[3]


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Return a small CSV file with every kind of column."""
    time_s = np.arange(0.0, 6000.0, 60.0)
    rows = ["time_s,T_box,panel_degC,Q_heater,pitch,mode,7th"]
    rows += [
        f"{t:g},{290 + 2 * np.sin(t / 900):.3f},{10 + 5 * np.sin(t / 700):.3f},{5 * (t > 3000)},{40 + t / 100},{int(t > 2000)},1"
        for t in time_s
    ]
    path = tmp_path / "flight.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_draft_is_a_specification_that_fits(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sat.yaml"
    assert main(["init", str(flight), "--out", str(out)]) == 0
    spec = load_spec(out)
    assert {name: c.unit for name, c in spec.channels.items() if c.kind == "temperature"} == {
        "T_box": "K",
        "panel_degC": "degC",
    }
    assert (
        spec.channels["Q_heater"].kind == "power" and spec.channels["mode"].levels and not spec.channels["pitch"].levels
    )
    assert [node.id for node in spec.nodes] == ["box", "panel"]
    assert "'7th' has no valid name" in capsys.readouterr().err
    assert main(["check", str(out), "--telemetry", str(flight)]) == 0
    assert "1 doubt, listed above; 2 nodes" in capsys.readouterr().out
    assert main(["init", str(flight), "--out", str(out)]) == 2, "an existing file stays"


def test_all_faults_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(
        "twin: x\nchannels: {T: {kind: temperature, unit: F}}\n"
        "nodes: [{id: a, sensor: T, capacity_J_per_K: 500}, {id: b, capacity_J_per_K: {gues: 3}}]\n"
        "conductors: [{between: [a, a], conductance_W_per_K: 0.5}, {between: [a, c]}]\n"
        "loads: [{channel: Q, node: d}]\n"
    )
    assert main(["check", str(path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    for said in (
        "nodes[0].capacity_J_per_K: write {value: 500} where it is known, or {guess: 500}",
        "conductors[0].conductance_W_per_K: write {value: 0.5}",
        "unit of a temperature channel is K or degC",
        ".gues: unknown field",
        "joins 'a' to itself",
        "conductors[1].between: unknown node or boundary 'c' (known: a, b)",
        "loads[0].node: unknown node 'd'",
        "loads[0].channel: unknown channel 'Q' (known: T)",
    ):
        assert sum(said in line for line in lines) == 1, (said, lines)
    path.write_text(
        "twin: x\nchannels: {T: {kind: temperature, unit: K}}\nnodes: [{id: a, sensor: U}, {id: b, sensor: T}]\n"
    )
    assert main(["check", str(path)]) == 1
    assert capsys.readouterr().out.count("unknown channel 'U'") == 1
    assert main(["check", str(path), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["valid"] is False
    assert main(["check", str(tmp_path / "none.yaml")]) == 2


def test_doubts_are_counted_instead_of_in_order(
    tmp_path: Path,
    pair_declared: dict[str, Any],
    pair_telemetry: Callable[[int], str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A record of ten rows is too short, and a column that nobody declares is ignored."""
    path, data, model = tmp_path / "spec.yaml", tmp_path / "data.csv", tmp_path / "model.json"
    path.write_text(yaml.safe_dump(pair_declared))
    argv = ["check", str(path), "--telemetry", str(data)]
    sizes = "2 nodes (0 without a sensor), 2 couplings, 1 load, 3 telemetry channels"
    for text, state in (
        (pair_telemetry(20), "in order"),
        (pair_telemetry(10), "1 doubt, listed above"),
        (pair_telemetry(10).replace("\n", ",7\n").replace("Q_a,7", "Q_a,P"), "2 doubts, listed above"),
    ):
        data.write_text(text)
        assert main(argv) == 0
        *doubts, last = capsys.readouterr().out.splitlines()
        assert last == f"{pair_declared['twin']}: {state}; {sizes}"
        assert len(doubts) == (0 if state == "in order" else int(state[0]))
        assert all(doubt.startswith(f"doubt: {data}: ") for doubt in doubts)
    assert f"{data}: 10 samples in all, too few to determine parameters" in doubts[-1]
    assert main([*argv, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["doubts"]) == 2
    assert main(["calibrate", "--spec", str(path), "--telemetry", str(data), "--out", str(model)]) == 0
    assert f"note: {data}: 10 samples in all, too few" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text, seconds",
    [("90", 90.0), ("90s", 90.0), ("1.5h", 5400.0), ("1d", 86400.0), ("1d12h", 129600.0), ("30min", 1800.0)],
)
def test_durations(text: str, seconds: float) -> None:
    assert DURATION.convert(text, None, None) == seconds


@pytest.mark.parametrize("text", ["soon", "1 day", "-3h", "h", "1y", ""])
def test_no_durations(text: str) -> None:
    with pytest.raises(click.UsageError, match="no duration"):
        DURATION.convert(text, None, None)


def test_the_shell_can_complete() -> None:
    environment = {**os.environ, "_TWIN_COMPLETE": "bash_complete", "COMP_WORDS": "twin cl", "COMP_CWORD": "1"}
    code = "from replay.cli.main import main; import sys; sys.argv = ['twin']; main()"
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=ROOT)
    assert "close-loop" in run.stdout
