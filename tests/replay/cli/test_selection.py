"""Which part of the telemetry a calibration takes: against slices made by hand, and the heat that a thinned input carries."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from replay.cli.main import main
from replay.cli.selection import Wanted, selected
from tests.helpers import record_of
from twin_core.errors import TelemetryError
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Flaw, Record

N = 300


@pytest.fixture(scope="module")
def spec(pair_declared: dict[str, Any]) -> TwinSpec:
    return load_spec(pair_declared)


def segment(first_s: float = 0.0) -> Record:
    """Return a segment a minute apart whose power is sampled only where it changes, every seventh minute."""
    time_s = first_s + 60.0 * np.arange(N)
    power = np.where(np.arange(N) % 7 == 0, 10.0 + np.arange(N), np.nan)
    return record_of(time_s, T_a=280.0 + np.arange(N), T_b=281.0 + np.arange(N), Q_a=power)


def test_all_of_it_unless_asked(spec: TwinSpec) -> None:
    record = segment()
    assert selected(spec, [record], Wanted()) == [record]


def test_the_newest_of_a_window_over_two_segments(spec: TwinSpec) -> None:
    taken = selected(spec, [segment(), segment(1e6)], Wanted("6000", "1003000", 90))
    assert [one.time_s.size for one in taken] == [40, 50]
    np.testing.assert_array_equal(taken[0].time_s, 60.0 * np.arange(260, 300))
    np.testing.assert_array_equal(taken[1].time_s, 1e6 + 60.0 * np.arange(50))
    assert taken[0].values["Q_a"][0] == 10.0 + 259  # what holds at minute 260 was sampled at 259
    assert taken[0].notices[-1].startswith("takes the newest 90 of 250 samples, 15600.0 to 1002940.0")


def test_a_thinned_segment_loses_no_heat(spec: TwinSpec) -> None:
    (taken,) = selected(spec, [segment()], Wanted(samples=30, thin=True))
    held = np.repeat(10.0 + np.arange(0, N, 7), 7)[:N]
    np.testing.assert_allclose(taken.values["Q_a"], held.reshape(30, 10).mean(axis=1))
    np.testing.assert_array_equal(taken.values["T_a"], 280.0 + np.arange(0, N, 10))
    assert "30 of 300 samples, one in 10" in taken.notices[-1]


def test_flaws_outside_are_not_told(spec: TwinSpec) -> None:
    flaws = (Flaw("T_a", "spike", 60.0, 60.0, 1), Flaw("T_b", "spike", 12_000.0, 12_000.0, 1))
    (taken,) = selected(spec, [replace(segment(), flaws=flaws)], Wanted(start="9000"))
    assert taken.flaws == flaws[1:]


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        (Wanted(start="17000"), "16 samples in the selected part"),
        (Wanted(start="2026-01-01T00:00:00Z"), "is a date"),
    ],
)
def test_what_cannot_be_taken_is_one_line(spec: TwinSpec, wanted: Wanted, words: str) -> None:
    with pytest.raises(TelemetryError, match=words):
        selected(spec, [segment()], wanted)


def test_a_number_is_no_date(spec: TwinSpec) -> None:
    with pytest.raises(TelemetryError, match="the record is dated"):
        selected(spec, [replace(segment(), epoch_ns=10**18)], Wanted(stop="100"))


def test_the_command_says_what_it_took(
    tmp_path: Path,
    pair_declared: dict[str, Any],
    pair_telemetry: Callable[[int], str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(pair_declared))
    (tmp_path / "data.csv").write_text(pair_telemetry(600))
    files = ["--spec", tmp_path / "spec.yaml", "--telemetry", tmp_path / "data.csv", "--out", tmp_path / "model.json"]
    command = [*map(str, ["calibrate", *files]), "--json"]
    assert main([*command, "--start", "2026-01-01T01:00:00Z", "--samples", "200"]) == 0
    summary = json.loads(capsys.readouterr().out)
    said = "takes the newest 200 of 540 samples, 2026-01-01T06:40:00Z to 2026-01-01T09:59:00Z"
    assert said in summary["notices"]
    found = {p["name"]: p["mean"] for p in summary["parameters"]}
    assert found["C:a"] == pytest.approx(1.1e4, rel=0.05)
    assert main([*command, "--thin"]) == 2
    assert "--samples" in capsys.readouterr().err
