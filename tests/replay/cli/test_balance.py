"""The steady state of a specification from the command line."""

import json
from pathlib import Path

import pytest

from replay.cli.main import main
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA

SPEC = """\
twin: plate
boundaries: {space: {value_K: 4}, room: {channel: T_room}}
channels:
  T: {kind: temperature, unit: K}
  T_room: {kind: temperature, unit: degC}
  Q: {kind: power, unit: W}
nodes: [{id: plate, sensor: T, capacity_J_per_K: {guess: 100}}, {id: mount, capacity_J_per_K: {value: 0}}]
conductors:
  - {between: [plate, mount], conductance_W_per_K: {guess: 0.5}}
  - {between: [mount, room], conductance_W_per_K: {guess: 0.5}}
radiators: [{node: plate, emissivity: 0.8, area_m2: 0.1, sink: space}]
loads: [{channel: Q, node: plate}]
"""


def test_the_heats_are_in_balance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "plate.yaml"
    path.write_text(SPEC)
    assert main(["balance", str(path), "--set", "Q=12", "--set", "T_room=20", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["temperature_K"]
    plate, mount = found["plate"], found["mount"]
    assert 12.0 + 0.25 * (293.15 - plate) == pytest.approx(SIGMA * 0.08 * (plate**4 - 4.0**4), abs=1e-5)
    assert mount == pytest.approx(0.5 * (plate + 293.15), abs=1e-6)
    assert main(["balance", str(path), "--set", "T_room=20"]) == 0
    assert "plate" in capsys.readouterr().out


@pytest.mark.parametrize(
    "argv, said",
    [([], "needs --set T_room"), (["--set", "T=3"], "no input"), (["--set", "T_room=warm"], "T_room=NUMBER")],
)
def test_what_cannot_be_set(argv: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "plate.yaml"
    path.write_text(SPEC)
    assert main(["balance", str(path), *argv]) == 2
    assert said in capsys.readouterr().err
