"""The demonstration as a user runs it: real processes, real HTTP, and nothing left running."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

COMMAND = [sys.executable, "-m", "replay.cli.main", "demo"]


def leftovers(folder: Path) -> list[str]:
    """Return the command lines of processes whose temporary folder is ours."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            environment = (process / "environ").read_bytes()
            command = (process / "cmdline").read_text().replace("\0", " ")
        except OSError:  # it ended meanwhile, or is not ours
            continue
        if f"TMPDIR={folder}".encode() in environment:
            found.append(command)
    return found


def environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "TMPDIR": str(folder)}


@pytest.mark.e2e
@pytest.mark.long
def test_from_orbit_to_verdict(tmp_path: Path) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    arguments = [*COMMAND, "--effect", "input_gain", "--seed", "0", "--out", "out", "--json"]
    run = subprocess.run(arguments, cwd=tmp_path, env=environment(scratch), capture_output=True, text=True, timeout=280)
    assert run.returncode == 0, run.stderr
    outcome = json.loads(run.stdout)
    assert outcome["hidden"]["effect"] == "input_gain" and outcome["found"] in ("named", "alternative")
    assert outcome["after_rmse_K"] < outcome["before_rmse_K"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["orbits.mcap", "report.html", "report.json"]
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "effect_added"
    assert leftovers(scratch) == [] and list(scratch.iterdir()) == []


@pytest.mark.e2e
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "terminated"])
def test_interrupted_while_the_service_runs(tmp_path: Path, number: signal.Signals) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    process = subprocess.Popen(
        [*COMMAND, "--effect", "none", "--out", "out"],
        cwd=tmp_path,
        env=environment(scratch),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    try:
        deadline = time.monotonic() + 120
        while not list(scratch.glob("twin-demo-*/twin.sqlite3")) and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130
    assert said.strip() == b"twin: interrupted"  # after the line end that click gives the terminal
    assert leftovers(scratch) == [] and list(scratch.iterdir()) == []
