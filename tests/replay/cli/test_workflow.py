"""The offline commands one after another, on telemetry of a pair whose capacities and conductance are known."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from replay.cli.close_loop import describe
from replay.cli.main import main

TRUE = {"C:a": 1.1e4, "C:b": 6.5e3, "G:a|b": 3.0}
"""What the telemetry of the fixture was made with."""


@pytest.fixture(scope="module")
def desk(
    tmp_path_factory: pytest.TempPathFactory, pair_declared: dict[str, Any], pair_telemetry: Callable[[int], str]
) -> Path:
    folder = tmp_path_factory.mktemp("desk")
    (folder / "spec.yaml").write_text(yaml.safe_dump(pair_declared))
    (folder / "data.csv").write_text(pair_telemetry(600))
    return folder


def run(capsys: pytest.CaptureFixture[str], *argv: str | Path) -> Any:
    """Run a command that must succeed and return what it printed, parsed."""
    code = main([*map(str, argv), "--json"])
    printed = capsys.readouterr()
    assert code == 0, printed.err
    return json.loads(printed.out)


def test_calibrate_then_forecast(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, data = desk / "model.json", desk / "data.csv"
    summary = run(capsys, "calibrate", "--spec", desk / "spec.yaml", "--telemetry", data, "--out", model)
    found = {p["name"]: p for p in summary["parameters"]}
    for name, value in TRUE.items():
        # Five standard deviations, and half a Euler step of 2 s on time constants of 2000 s and more.
        assert found[name]["mean"] == pytest.approx(value, rel=1e-3, abs=5 * found[name]["std"])
    out = desk / "forecast.json"
    printed = run(
        capsys, "forecast", "--model", model, "--telemetry", data, "--horizon", "1800", "--step", "600", "--out", out
    )
    assert json.loads(out.read_text()) == printed
    assert printed["time"][0] == "2026-01-01T10:09:00Z" and len(printed["time"]) == 3
    assert printed["units"] == {"T_a": "degC", "T_b": "K"}
    for sensor, bands in printed["values"].items():
        assert set(bands) == {"mean", "q05", "q50", "q95"}
        assert all(low < mid < high for low, mid, high in zip(bands["q05"], bands["q50"], bands["q95"], strict=True))
        assert abs(bands["mean"][0]) < 100 if sensor == "T_a" else bands["mean"][0] > 200


def test_forecast_follows_its_plan(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, data = desk / "model.json", desk / "data.csv"
    run(capsys, "calibrate", "--spec", desk / "spec.yaml", "--telemetry", data, "--out", model)
    ends = {}
    for power_W in (0, 200):
        plan = desk / f"plan{power_W}.csv"
        plan.write_text(f"time,Q_a\n2026-01-01T09:59:00Z,{power_W}\n")
        out = desk / f"forecast{power_W}.csv"
        run(capsys, "forecast", "--model", model, "--telemetry", data, "--horizon", "600", "--plan", plan, "--out", out)
        rows = list(csv.DictReader(out.read_text().splitlines()))
        ends[power_W] = float(rows[-1]["T_a_mean"])
    # 200 W for 600 s into 11 kJ/K: 10.9 K, less what flows on to the neighbour and to space meanwhile.
    assert 8.0 < ends[200] - ends[0] < 10.9


def test_a_plan_with_readings_is_told_that_they_change_nothing(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, data, plan = desk / "model.json", desk / "data.csv", desk / "plan.csv"
    run(capsys, "calibrate", "--spec", desk / "spec.yaml", "--telemetry", data, "--out", model)
    written = []
    for text in ("time,Q_a\n2026-01-01T09:59:00Z,50\n", "time,T_a,Q_a\n2026-01-01T09:59:00Z,400,50\n"):
        plan.write_text(text)
        command = ("forecast", "--model", model, "--telemetry", data, "--horizon", "600", "--plan", plan)
        assert main([*map(str, command), "--out", str(desk / "ahead.csv")]) == 0
        told = capsys.readouterr().err
        assert ("ignored T_a, which the forecast predicts" in " ".join(told.split())) == ("T_a" in text)
        written.append((desk / "ahead.csv").read_text())
    assert written[0] == written[1]


def test_a_forecast_says_where_a_learned_heat_is_not_at_home(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A model file whose heat was learned some kelvin away: the note goes to stderr and into the document."""
    model, data, out = desk / "model.json", desk / "data.csv", desk / "beyond.json"
    run(capsys, "calibrate", "--spec", desk / "spec.yaml", "--telemetry", data, "--out", model)
    document = json.loads(model.read_text())
    settings = {"degree": 0, "vanishing": False, "low_K": [100.0], "high_K": [110.0], "misfit_W": 0.0}
    heat = {
        "effect": "learned_heat_flow",
        "where": {"node": "a"},
        "settings": settings | {"covariance_W2": []},
        "values": {"coefficients[0]": 0.5},
    }
    value = {"learned_heat_flow(a).coefficients[0]": 0.5}
    document |= {"effects": [heat], "values": document["values"] | value, "free_names": [], "covariance": []}
    model.write_text(json.dumps(document))
    asked = ["forecast", "--model", model, "--telemetry", data, "--horizon", "600", "--out", out, "--json"]
    assert main([*map(str, asked)]) == 0
    printed = capsys.readouterr()
    notice = json.loads(printed.out)["notices"][-1]
    assert notice.startswith(
        "learned_heat_flow(a): learned at a 100.00 to 110.00 K; 100% of the prediction lies outside"
    )
    assert notice in printed.err


def test_close_loop_leaves_its_three_files(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = desk / "loop"
    arguments = ["close-loop", "--spec", desk / "spec.yaml", "--telemetry", desk / "data.csv", "--out", out]
    report = run(capsys, *arguments)
    assert sorted(path.name for path in out.iterdir()) == ["model.json", "report.html", "report.json"]
    assert json.loads((out / "report.json").read_text()) == report
    assert report["verdict"] == "no_effect_supported" and report["findings"] == []
    assert report["holdout"]["stop"] == "2026-01-01T09:59:00Z"
    assert "pair" in (out / "report.html").read_text()
    assert main([str(a) for a in arguments]) == 0  # once more into the folder that exists, for people
    printed = capsys.readouterr()
    assert "The declared model suffices" in printed.out and printed.err == ""


def spoilt(text: str) -> str:
    """Return telemetry in which rows 101 to 118 repeat row 100, T_a leaps at rows 200 and 201, and T_b drops to 0 K at 300."""
    head, *rows = text.splitlines()
    cells = [row.split(",") for row in rows]
    for row in range(101, 119):  # the power holds as long, so that it is known
        cells[row][1:] = cells[100][1:]
    for row in (200, 201):
        cells[row][1] = f"{float(cells[row][1]) + 60.0:.4f}"
    cells[300][2] = "0"
    return "\n".join([head, *map(",".join, cells)]) + "\n"


def test_what_is_no_reading_is_masked_told_and_drawn(
    desk: Path, capsys: pytest.CaptureFixture[str], pair_telemetry: Callable[[int], str]
) -> None:
    data, out = desk / "spoilt.csv", desk / "spoilt"
    data.write_text(spoilt(pair_telemetry(600)))
    report = run(capsys, "close-loop", "--spec", desk / "spec.yaml", "--telemetry", data, "--out", out)
    assert report["verdict"] == "no_effect_supported"
    assert sorted((row["channel"], row["reason"], row["samples"], row["spans"]) for row in report["quality"]) == [
        ("Q_a", "frozen", 18, 1),
        ("T_a", "frozen", 18, 1),
        ("T_a", "spike", 2, 1),
        ("T_b", "frozen", 18, 1),
        ("T_b", "sentinel", 1, 1),
    ]
    page = (out / "report.html").read_text()
    assert "Telemetry that was left out" in page and page.count("<title>T_a: 2 spike") == 1


def test_without_masking_every_sample_counts(
    desk: Path, capsys: pytest.CaptureFixture[str], pair_telemetry: Callable[[int], str]
) -> None:
    data, model = desk / "raw.csv", desk / "raw.json"
    data.write_text(spoilt(pair_telemetry(600)).replace(",0,", ",271.5,"))
    arguments = ("calibrate", "--spec", desk / "spec.yaml", "--telemetry", data, "--out", model)
    clean, raw = run(capsys, *arguments), run(capsys, *arguments, "--no-masking")
    assert any("2 readings of 'T_a' left out as spikes" in notice for notice in clean["notices"])
    assert (
        raw["notices"] == [] and raw["per_sensor"]["T_a"]["rmse_K"] > 2.0 > 0.1 > clean["per_sensor"]["T_a"]["rmse_K"]
    )
    forecast = ("forecast", "--model", model, "--telemetry", data, "--horizon", "600", "--out", desk / "raw_ahead.csv")
    assert run(capsys, *forecast)["issued"] == run(capsys, *forecast, "--no-masking")["issued"]


def test_simulate_in_both_formats(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = {
        "scenario": "plate",
        "mesh_size_m": 0.1,
        "time": {"duration_s": 600, "step_s": 60, "sample_s": 60},
        "regions": [{"id": "plate", "x_m": [0, 0.2], "y_m": [0, 0.2], "material": "electronics_box"}],
        "sensors": [{"channel": "T_plate", "region": "plate", "noise_std_K": 0.1}],
    }
    (tmp_path / "plate.yaml").write_text(yaml.safe_dump(scenario))
    for name in ("a.csv", "a.mcap"):
        outcome = run(capsys, "simulate", "--scenario", tmp_path / "plate.yaml", "--out", tmp_path / name)
        assert outcome["channels"] == ["T_plate"]
        assert (tmp_path / name).stat().st_size > 0
    rows = (tmp_path / "a.csv").read_text().splitlines()
    assert rows[0] == "time_s,T_plate" and len(rows) == outcome["samples"] + 1


def test_a_setting_without_uncertainty_is_told_without_one() -> None:
    finding = {"effect": "x", "where": {"node": "a"}, "parameters": {"degree": {"mean": 2, "std": None}}}
    assert describe(finding) == "x at a (degree = 2)"
    finding["parameters"] = {"Q_W": {"mean": 2.5, "std": 0.25}}
    assert describe(finding) == "x at a (Q_W = 2.5 ± 0.25)"
