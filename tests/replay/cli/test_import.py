"""``twin import``: files that are no model, or only a part of one, are told apart in a line that says what to do."""

import shlex
from pathlib import Path

import pytest

from replay.cli.main import main
from tests.twin_core.interchange.test_decks import SINDA


def test_the_case_file_of_a_sinda_deck_names_the_files_to_give(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, text in SINDA.items():
        (tmp_path / name).write_text(text.replace("-BOX.3", "BOX.-3"))
    out = tmp_path / "case.yaml"
    assert main(["import", str(tmp_path / "case.inp"), "--out", str(out)]) == 2
    told = capsys.readouterr().err
    assert "case.inp: part of a SINDA deck that declares no node" in told and told.count("\n") == 1
    advised = shlex.split(told[told.index("twin import") :].replace("SPEC", str(out)))[1:]
    assert main(advised) == 0
    assert "3 nodes" in capsys.readouterr().out
    assert main(["import", str(tmp_path / "case.cc"), "--out", str(out)]) == 0
    told = capsys.readouterr().err
    assert all(f"{name}: lies beside the deck and was not given" in told for name in ("case.k", "case.hra"))


def test_what_is_no_model_is_told_what_one_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("Temperatures of the bus, see the drawing.\n")
    assert main(["import", str(tmp_path / "notes.txt"), "--out", str(tmp_path / "sat.yaml")]) == 2
    told = capsys.readouterr().err
    assert "is no model that can be read" in told and told.count("\n") == 1


def test_a_model_of_which_nothing_is_left_says_what_was_not_understood(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.json").write_text('{"comps": [{"class_name": "Radiometer", "name": "r"}], "pars": []}')
    arguments = ["import", str(tmp_path / "own.json"), "--out", str(tmp_path / "sat.yaml")]
    assert main(arguments) == 2
    assert "line 1: Radiometer 'r' is not a component that can be translated" in capsys.readouterr().err
    assert main([*arguments, "--skip-unknown"]) == 2
    assert "declares no node" in capsys.readouterr().err
