"""Effects of the user's own on the command line: checked, found by the loop, kept by the model, missed where they lack."""

import json
from pathlib import Path

import pytest
import yaml

from replay.cli.main import main
from tests.louver import AREA_M2, PLUGIN, RANGE_K, SHUT_K, SPEC, csv
from twin_core.effects import REGISTRY
from twin_core.effects.check import CHECKS

pytestmark = pytest.mark.usefixtures("plugins_forgotten")

BROKEN = PLUGIN.read_text().replace("moving * bare - share", "share * bare - share")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("desk")
    (folder / "spec.yaml").write_text(yaml.safe_dump(SPEC))
    (folder / "data.csv").write_text(csv(600))
    (folder / "broken.py").write_text(BROKEN)
    return folder


def test_check_effect_prints_its_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-effect", str(PLUGIN)]) == 0
    printed = capsys.readouterr().out
    assert "louver: q = sigma R s (T_s^4 - T^4)" in printed
    assert printed.count("  ok     ") == len(CHECKS) and "WRONG" not in printed


def test_check_effect_tells_what_is_wrong(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-effect", str(desk / "broken.py")]) == 2
    printed = capsys.readouterr()
    assert printed.out.count("WRONG") == 1
    assert printed.err.startswith(
        f"twin: {desk / 'broken.py'}: effect louver: derivatives: d heat / d T of a is off by"
    )
    assert printed.err.count("\n") == 1


def test_check_effect_for_machines(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-effect", str(desk / "broken.py"), "--json"]) == 2
    (found,) = json.loads(capsys.readouterr().out)["effects"]
    assert (found["effect"], found["passed"]) == ("louver", False)
    assert [check["check"] for check in found["checks"] if not check["passed"]] == ["derivatives"]


@pytest.mark.parametrize(
    "argv",
    [
        ["calibrate", "--spec", "spec.yaml", "--telemetry", "data.csv", "--out", "model.json"],
        ["close-loop", "--spec", "spec.yaml", "--telemetry", "data.csv", "--out", "loop"],
        ["forecast", "--model", "model.json", "--telemetry", "data.csv", "--horizon", "60", "--out", "out.csv"],
        ["serve"],
    ],
)
def test_a_broken_plugin_ends_a_command_in_one_line(
    desk: Path, argv: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(desk)
    assert main([*argv, "--effects", "broken.py"]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("twin: broken.py: effect louver: derivatives: ")
    assert printed.err.count("\n") == 1 and printed.out == ""
    assert "twin check-effect broken.py" in printed.err


def test_a_plugin_that_fails_on_the_way_is_blamed_and_not_the_program(
    desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = desk / "late.py"
    before = '        """Yield the null effect at blade'
    text = PLUGIN.read_text().replace(before, '        assert where["node"] != "panel", "no panel"\n' + before)
    file.write_text(text)
    line = 1 + text[: text.index("assert where")].count("\n")
    command = ["close-loop", "--spec", str(desk / "spec.yaml"), "--telemetry", str(desk / "data.csv")]
    assert main([*command, "--effects", str(file), "--out", str(desk / "late")]) == 2
    assert capsys.readouterr().err == f"twin: {file}:{line}: AssertionError: no panel; correct the plug-in\n"


@pytest.mark.long
def test_the_loop_finds_a_louver_and_a_forecast_needs_its_plugin(
    desk: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = desk / "loop"
    command = ["close-loop", "--spec", str(desk / "spec.yaml"), "--telemetry", str(desk / "data.csv")]
    assert main([*command, "--effects", str(PLUGIN), "--out", str(out)]) == 0
    assert "a louver between panel and space was missing" in capsys.readouterr().out
    report = json.loads((out / "report.json").read_text())
    (finding,) = report["findings"]
    assert (finding["effect"], finding["where"]) == ("louver", {"node": "panel", "sink": "space"})
    truth = {"R_m2": AREA_M2, "T_shut_K": SHUT_K, "T_range_K": RANGE_K}
    for name, value in truth.items():
        found = finding["parameters"][name]
        assert abs(found["mean"] - value) < 4.0 * found["std"] + 1e-3 * value, name
    assert report["after"]["rmse_K"] < 0.1 < 1.0 < report["before"]["rmse_K"]
    ahead = ["forecast", "--model", str(out / "model.json"), "--telemetry", str(desk / "data.csv")]
    ahead += ["--horizon", "600", "--out", str(desk / "ahead.csv")]
    assert main([*ahead, "--effects", str(PLUGIN)]) == 0
    monkeypatch.setattr(REGISTRY, "_kinds", {k: v for k, v in REGISTRY.items() if k != "louver"})
    capsys.readouterr()
    assert main(ahead) == 2
    message = "effects[0].effect: unknown effect 'louver', which comes from a plug-in; give it with --effects louver.py"
    assert message in capsys.readouterr().err
    monkeypatch.setenv("TWIN_EFFECTS", str(PLUGIN))
    assert main(ahead) == 0
