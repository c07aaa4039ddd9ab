"""The command line on balance phases: what it prints, what it leaves, and what it refuses."""

import json
import re
from pathlib import Path

import pytest
import yaml

from replay.cli.main import main
from tests.twin_core.calibrate.test_phases import TRUTH, rest, spec, transient
from twin_core.network.spec_io import dump_spec
from twin_core.telemetry_csv import write_columns


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    paths = {name: tmp_path / name for name in ("spec.yaml", "balance.csv", "flown.csv")}
    paths["spec.yaml"].write_text(yaml.safe_dump(dump_spec(spec())))
    rows = [("hot", rest(60.0, 30.0)), ("cold", rest(10.0, -20.0))]
    lines = [f"{name},{r['T_a']:.6f},{r['T_b']:.6f},{r['T_plate']},{r['Q']}" for name, r in rows]
    paths["balance.csv"].write_text("\n".join(["phase,T_a,T_b,T_plate,Q", *lines]) + "\n")
    units = {name: channel.unit for name, channel in spec().channels.items()}
    write_columns(paths["flown.csv"], transient(), units)
    return paths


def test_phases_are_correlated_and_told(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [
        "--spec",
        str(files["spec.yaml"]),
        "--steady",
        str(files["balance.csv"]),
        "--transient",
        str(files["flown.csv"]),
    ]
    out = tmp_path / "out"
    assert main(["correlate", *given, "--author", "A. Body", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "meets the criteria in every phase" in printed and "hot" in printed and "flown" in printed
    report = json.loads((out / "report.json").read_text())
    assert [phase["phase"] for phase in report["phases"]] == ["hot", "cold", "flown"]
    rows = {row["name"]: row for row in report["parameters"]}
    assert rows["G:b|plate"]["corrected"]["mean"] == pytest.approx(TRUTH["G:b|plate"], rel=0.02)
    assert len(report["document"]["files"]) == 3 and report["sensitivity"]["rows"]
    page = (out / "report.html").read_text()
    assert "A. Body" in page and "Mean deviation of each sensor" in page and "nan" not in page.split("<script")[0]
    drawn = re.findall(r'<svg class="residuals deviations".*?</svg>', page)
    assert [drawing.count('circle class="after"') for drawing in drawn] == [2, 2, 2]  # three phases of two sensors
    assert "Residuals in flown" in page and "Residuals in hot" not in page
    (flown,) = re.findall(r"<h3>Residuals in flown</h3>(.*?)</section>", page, re.DOTALL)
    assert flown.count('<svg class="residuals"') == 2 and flown.count('class="bar after"') == 2
    assert json.loads((out / "model.json").read_text())["values"]["C:a"] == pytest.approx(TRUTH["C:a"], rel=0.05)


def test_what_is_wrong_is_told_in_one_line(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["correlate", "--spec", str(files["spec.yaml"]), "--out", str(tmp_path / "out")]
    assert main(given) == 2
    files["balance.csv"].write_text("T_a,T_b,T_plate,Q\n1,2,3,4\n")
    assert main([*given, "--steady", str(files["balance.csv"])]) == 2
    assert "has no column 'phase'" in capsys.readouterr().err
    files["balance.csv"].write_text("phase,T_a,T_b,T_plate,Q\nhot,20,20,20,1\ncold,-999,20,20,1\n")
    assert main([*given, "--steady", str(files["balance.csv"])]) == 2
    assert "balance.csv: row 3: column 'T_a' holds -999" in capsys.readouterr().err
