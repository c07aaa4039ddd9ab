"""The closed loop on spacecraft that SciPy simulated: it finds what is missing, and nothing where nothing is."""

import json
import re
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from benchmarks.case import Case
from benchmarks.network_cases import network_case
from twin_core import closed_loop
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.summary import to_model
from twin_core.calibrate.suspicions import Looked, Suspicion
from twin_core.closed_loop import ClosedLoop, close_loop
from twin_core.discover.judge import MISTAKE
from twin_core.effects import REGISTRY
from twin_core.errors import Cancelled, ModelError, TelemetryError
from twin_core.holdout import HeldOut, Prediction, predict, split_burn_in, split_fraction
from twin_core.network.spec_io import load_spec
from twin_core.report.mistakes import Mistakes
from twin_core.telemetry import Record

CASES = {
    "radiation_to_sink": 5,
    "leak_to_boundary": 1,
    "missing_conductor": 1,
    "input_gain": 1,
    "input_step": 1,
}
"""Effect -> seed of a small spacecraft over five orbits, a sample every three minutes."""


def small_case(effect: str | None, seed: int) -> Case:
    return network_case(effect, seed, n_orbits=5, dt_s=180.0)


@dataclass(frozen=True)
class Run:
    case: Case
    loop: ClosedLoop
    progress: tuple[float, ...]

    @property
    def report(self) -> dict[str, Any]:
        return self.loop.report


@cache
def solved(effect: str | None) -> Run:
    """Return the closed loop of a case, run once."""
    case, heard = small_case(effect, CASES.get(effect or "", 1)), []
    loop = close_loop(case.spec, [case.record], progress=lambda f, m: heard.append(f))
    return Run(case, loop, tuple(heard))


@pytest.fixture(params=list(CASES))
def run(request: pytest.FixtureRequest) -> Run:
    return solved(request.param)


@pytest.fixture
def healthy() -> Run:
    return solved(None)


def named(report: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Return what the report names or lists as indistinguishable."""
    return [(row["effect"], row["where"]) for f in report["findings"] for row in (f, *f["alternatives"])]


def test_the_missing_effect_is_found_in_its_place(run: Run) -> None:
    assert run.report["verdict"] == "effect_added"
    assert (run.case.effect, run.case.where) in named(run.report)
    assert run.report["findings"][0]["effect"] == run.case.effect


def test_the_held_out_error_falls_to_the_noise(run: Run) -> None:
    before, after = run.report["before"]["rmse_K"], run.report["after"]["rmse_K"]
    assert after < 0.8 * before
    assert after < 1.5 * run.report["noise_floor_K"]
    assert run.report["residual_whiteness"]["after"] < run.report["residual_whiteness"]["before"]


def test_an_onset_is_told_in_the_telemetrys_own_form() -> None:
    run = solved("input_step")
    assert run.case.onset_s is not None
    (finding,) = [f for f in run.report["findings"] if f["effect"] == "input_step"]
    time = finding["parameters"]["time"]
    span = float(run.case.record.time_s[-1])
    assert abs(time["mean"] - run.case.onset_s) < 0.02 * span
    assert 0.0 < time["std"] < 0.02 * span


def test_the_corrected_model_carries_the_effect(run: Run) -> None:
    places = {effect.place for effect in run.loop.model.effects}
    assert len(places) == len(run.report["findings"])
    assert run.loop.before_model.effects == ()
    assert run.loop.model.network().parameters.free_names == run.loop.model.free_names


@pytest.mark.parametrize("effect", [None, "leak_to_boundary"])
def test_readings_that_rows_repeat_count_once(effect: str | None) -> None:
    """A recorder that writes each reading for some rows makes no stairs that heat would have to explain."""
    case = network_case(effect, 1, n_orbits=5, dt_s=60.0)
    n_times = case.record.time_s.size
    begins = np.flatnonzero(np.random.default_rng(3).random(n_times) < 0.3)
    shown = np.maximum.accumulate(np.isin(np.arange(n_times), begins) * np.arange(n_times))
    held = {name: case.record.values[name][shown] for name in case.spec.sensors}
    record = Record(case.record.time_s, {**case.record.values, **held}, case.record.epoch_ns, "held")
    report = close_loop(case.spec, [record]).report
    assert {row["reason"] for row in report["quality"]} == {"held"}
    assert [(f["effect"], f["where"]) for f in report["findings"]] == ([(effect, case.where)] if effect else [])
    assert report["after"]["rmse_K"] < 1.5 * case.noise_K


def test_a_corrected_model_that_cannot_predict_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(model: CalibratedModel, held: HeldOut) -> Prediction:
        if model.effects:
            raise ModelError("the heat balance has no solution over the hold-out")
        return predict(model, held)

    monkeypatch.setattr(closed_loop, "predict", fails)
    case = small_case("leak_to_boundary", CASES["leak_to_boundary"])
    report = close_loop(case.spec, [case.record]).report
    assert report["findings"] == [] and report["verdict"] != "effect_added"
    assert report["after"] == report["before"]
    assert any("no solution over the hold-out" in reason for reason in report["failures"])


@pytest.mark.long
@pytest.mark.parametrize("effect", [None, "leak_to_boundary"])
def test_a_mistake_of_the_declaration_comes_before_missing_physics(effect: str | None) -> None:
    """Of a sensor in degC that was declared in K a heat of 6e10 W was told, beside the words that it was in degC."""
    case = small_case(effect, CASES.get(effect or "", 1))
    name = case.spec.sensors[0]
    shifted = replace(case.record, values={**case.record.values, name: case.record.values[name] - 273.15})
    report = close_loop(case.spec, [shifted]).report
    assert report["findings"] == [] and report["verdict"] == "unexplained"
    assert (report["suspicions"][0]["mistake"], report["suspicions"][0]["where"]) == ("unit", [name])
    assert report["notices"][0].startswith(f"perhaps channel '{name}' is in degC, not in K")


def test_findings_that_a_mistake_outdoes_are_listed_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    case = small_case("leak_to_boundary", CASES["leak_to_boundary"])
    words = "sensors 'a' and 'b' are swapped"
    looked = Looked([Suspicion("swapped sensors", ("a", "b"), words, 0.1, 90.0)], 1, 1, complete=True)
    monkeypatch.setattr(closed_loop, "look_for_mistakes", lambda *given, **named: Mistakes(looked))
    report = close_loop(case.spec, [case.record]).report
    assert report["findings"] == [] and report["after"] == report["before"]
    assert MISTAKE in {row["reason"] for row in report["not_supported"]}
    assert any(words in line for line in report["notices"])


def without_a_declared_solution(model: CalibratedModel, held: HeldOut, *, holding: bool = False) -> Prediction:
    if not model.effects and not holding:
        raise ModelError("b.csv: the heat balance has no solution over the hold-out")
    return replace(predict(model, held), notices=("the last temperatures are held",) if holding else ())


def test_a_declared_model_that_cannot_predict_says_what_the_record_leaves_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """A heater that rests in training and runs afterwards: the fit may have shrunk what it heats to nothing."""
    monkeypatch.setattr(closed_loop, "predict", without_a_declared_solution)
    case = small_case("leak_to_boundary", CASES["leak_to_boundary"])
    _, calibration = fit_network(case.spec, split_fraction([case.record], 0.3)[0])
    model = to_model(calibration, ())
    open_words = model.summary | {"words": ["the data do not determine C:b; it ended 91 times below its guess"]}
    _, lost = closed_loop._predicted(replace(model, summary=open_words), split_fraction([case.record], 0.3)[1])
    assert lost is not None and re.search(r"no solution.*C:b.*a value or bounds", str(lost))


def test_a_declared_model_that_cannot_predict_ends_a_run_where_nothing_corrects_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(closed_loop, "predict", without_a_declared_solution)
    case = small_case("leak_to_boundary", CASES["leak_to_boundary"])
    found = close_loop(case.spec, [case.record]).report
    assert [f["effect"] for f in found["findings"]] == ["leak_to_boundary"]
    assert found["after"]["rmse_K"] < found["before"]["rmse_K"]
    assert found["notices"].count("the last temperatures are held") == 1
    with pytest.raises(ModelError, match="no solution over the hold-out"):
        close_loop(case.spec, [case.record], deadline_s=1e-3)  # which leaves no time to find anything


def check_score(score: dict[str, Any], sensors: tuple[str, ...]) -> None:
    assert score["rmse_K"] >= 0.0 and -1.0 <= score["pcc"] <= 1.0
    assert set(score["per_sensor"]) == set(sensors)
    for row in score["per_sensor"].values():
        assert {"rmse_K", "pcc", "bias_K"} <= set(row)
        assert abs(row["bias_K"]) <= row["rmse_K"] + 1e-12


def check_report(report: dict[str, Any], case: Case) -> None:
    """Assert the shape of contract section 6."""
    assert report["twin"] == case.spec.twin
    assert report["verdict"] in ("effect_added", "no_effect_supported", "unexplained")
    for part in ("train", "holdout"):
        span = report[part]
        assert span["start"] < span["stop"] and isinstance(span["samples"], int) and span["samples"] > 0
    assert report["train"]["stop"] <= report["holdout"]["start"]
    for part in ("before", "after"):
        check_score(report[part], case.spec.sensors)
    assert report["noise_floor_K"] > 0.0 and report["elapsed_s"] > 0.0
    assert set(report["residual_whiteness"]) == {"before", "after"}
    for finding in report["findings"]:
        check_finding(finding)
    factors = [f["evidence"]["log_bayes_factor"] for f in report["findings"]]
    assert factors == sorted(factors, reverse=True)


def check_finding(finding: dict[str, Any]) -> None:
    kind = REGISTRY[finding["effect"]]
    assert tuple(finding["where"]) in {kind.keys, kind.keys + kind.optional_keys}
    assert finding["parameters"] and finding["evidence"]["log_bayes_factor"] > 0.0
    assert 0.0 <= finding["evidence"]["p_value"] <= 1.0
    for row in finding["parameters"].values():
        assert set(row) == {"mean", "std"}
    for other in finding["alternatives"]:
        rival = REGISTRY[other["effect"]]
        assert tuple(other["where"]) in {rival.keys, rival.keys + rival.optional_keys}
        assert other["log_bayes_factor"] >= finding["evidence"]["log_bayes_factor"] - 3.0 - 1e-9
        assert (other["effect"], other["where"]) != (finding["effect"], finding["where"])


def test_the_report_keeps_its_form(run: Run, healthy: Run) -> None:
    for each in (run, healthy):
        check_report(each.report, each.case)
        assert json.loads(json.dumps(each.report, allow_nan=False)) == each.report


def test_the_plots_are_plain_data(run: Run, healthy: Run) -> None:
    for each in (run, healthy):
        plots = json.loads(json.dumps(each.loop.plots, allow_nan=False))
        assert len(plots["time"]) <= 2000
        assert set(plots["sensors"]) == set(each.case.spec.sensors)
        for curves in plots["sensors"].values():
            assert len(curves["measured"]) == len(curves["before"]) == len(curves["after"]) == len(plots["time"])
        assert plots["time"][0] <= plots["holdout_start"] <= plots["time"][-1]


@pytest.mark.parametrize("effect", ["radiation_to_sink", "leak_to_boundary", "missing_conductor"])
def test_the_line_of_a_coupling_lies_on_its_points(effect: str) -> None:
    """The slope of heat over what drives it is the parameter, in W/K or m2, and the line passes through the points."""
    run = solved(effect)
    (drawn,) = run.loop.plots["driven_heat"]
    (row,) = (r for f in run.report["findings"] for r in f["parameters"].values())
    x, heat, std, line = (np.array(drawn[key]) for key in ("x", "heat_W", "std_W", "effect_W"))
    np.testing.assert_allclose(line, row["mean"] * x, rtol=0.02, atol=0.02 * np.abs(line).max())
    assert np.polyfit(x, heat, 1)[0] == pytest.approx(row["mean"], rel=0.1)
    assert np.mean(np.abs(heat - line) < 2.0 * std) > 0.9


def test_heat_flows_add_up(run: Run) -> None:
    for phase in run.report["heat_flows"]:
        net = {node["id"]: 0.0 for node in phase["nodes"]}
        for link in phase["links"]:
            for end, sign in zip(link["ends"], (-1.0, 1.0), strict=True):
                if end in net:
                    net[end] += sign * link["heat_W"]
        for node, heat_W in [(row["node"], row["heat_W"]) for row in phase["loads"]]:
            net[node] += heat_W
        for effect in phase["effects"]:
            for node, heat_W in effect["heat_W"].items():
                net[node] += heat_W
        assert net == pytest.approx({node["id"]: node["heat_W"] for node in phase["nodes"]}, abs=1e-6)


def test_the_ensemble_is_that_of_all_readings(run: Run) -> None:
    for when in ("before", "after"):
        figures = run.report["ensemble"][when]
        assert figures["rmse_K"] == pytest.approx(run.report[when]["rmse_K"])
        assert figures["bias_K"] ** 2 + figures["std_K"] ** 2 == pytest.approx(figures["rmse_K"] ** 2)
        assert figures["max_abs_K"] == max(row["max_abs_K"] for row in run.report[when]["per_sensor"].values())
        assert 0.0 <= figures["share_within"] <= 1.0


def test_nothing_is_found_where_nothing_is_missing(healthy: Run) -> None:
    assert healthy.report["verdict"] == "no_effect_supported"
    assert healthy.report["findings"] == []
    assert healthy.report["before"] == healthy.report["after"]
    assert healthy.loop.model is healthy.loop.before_model


def test_the_hold_out_takes_no_part() -> None:
    """Whatever comes after the cut, garbage or the truth: findings, evidence and both models are the same to the bit."""
    truth = solved("leak_to_boundary")
    case, record = truth.case, truth.case.record
    cut = 0.7 * float(record.time_s[-1] - record.time_s[0]) + float(record.time_s[0])
    late = np.flatnonzero(record.time_s > cut + 1e-6)
    rng = np.random.default_rng(0)
    garbage = {name: column.copy() for name, column in record.values.items()}
    for name, column in garbage.items():
        column[late] = rng.permutation(column[late]) * (1.0 if name in ("mode", "T_room") else 0.9)
    spoilt = close_loop(case.spec, [Record(record.time_s, garbage, None, record.name)])
    assert truth.report["findings"] and spoilt.report["findings"] == truth.report["findings"]
    for key in ("verdict", "train", "not_supported", "training", "noise_floor_K"):
        assert spoilt.report[key] == truth.report[key], key
    assert spoilt.model.to_json() == truth.loop.model.to_json()
    assert spoilt.before_model.to_json() == truth.loop.before_model.to_json()
    assert spoilt.report["after"]["rmse_K"] > 2.0 * truth.report["after"]["rmse_K"]


def tiny() -> Case:
    """Return three coarse orbits of a healthy spacecraft: enough to run."""
    return network_case(None, 1, n_orbits=3, dt_s=300.0)


def test_separate_hold_out_files_with_a_burn_in() -> None:
    case = tiny()
    position = np.arange(case.record.time_s.size)
    first, second = case.record.take(position < 35), case.record.take(position >= 35)
    loop = close_loop(case.spec, [first], holdout_records=[second], burn_in_s=1800.0)
    check_report(loop.report, case)
    assert loop.report["train"]["samples"] == 35
    assert loop.report["holdout"]["start"] == second.time_s[0] + 1800.0
    assert loop.report["holdout"]["samples"] == second.time_s.size - 1 - 6


def test_excluded_intervals_of_the_hold_out_are_not_scored() -> None:
    case = tiny()
    stop = float(case.record.time_s[-1]) + 1.0
    data = case.spec.model_dump(mode="json", exclude_none=True)
    spec = load_spec(data | {"exclude": [{"start": stop - 1500.0, "stop": stop, "reason": "safe mode"}]})
    report = close_loop(spec, [case.record]).report
    late = int((case.record.time_s > report["train"]["stop"]).sum())
    assert report["holdout"]["samples"] == late - 5
    assert report["holdout"]["stop"] == case.record.time_s[-1]


def test_progress_runs_from_start_to_end(run: Run) -> None:
    assert list(run.progress) == sorted(run.progress)
    assert 0.0 <= run.progress[0] < 0.1 and run.progress[-1] == 1.0
    assert len(set(run.progress)) >= 20


def test_a_loop_can_be_cancelled() -> None:
    def stop(fraction: float, message: str) -> None:
        if fraction > 0.2:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        close_loop(tiny().spec, [tiny().record], progress=stop)


@pytest.mark.parametrize("rate", [0.0, 1.0, -1.0, 2.0, np.nan])
def test_an_impossible_false_alarm_rate_is_refused(rate: float) -> None:
    case = tiny()
    with pytest.raises(TelemetryError, match="false_alarm_rate: must be between 0 and 1"):
        close_loop(case.spec, [case.record], false_alarm_rate=rate)


def test_no_telemetry_is_refused() -> None:
    with pytest.raises(TelemetryError, match="no telemetry given"):
        close_loop(tiny().spec, [])


def test_what_begins_in_the_part_that_was_kept_back_is_said() -> None:
    case = tiny()
    late = case.record.time_s > np.quantile(case.record.time_s, 0.85)
    jumped = {sensor: case.record.values[sensor] + 20.0 * late for sensor in case.spec.sensors}
    changed = replace(case.record, values={**case.record.values, **jumped})
    notices = [close_loop(case.spec, [record]).report["notices"] for record in (changed, case.record)]
    told = [[notice for notice in some if "the part that was kept back fits" in notice] for some in notices]
    assert len(told[0]) == 1 and not told[1]


def test_a_held_out_error_that_does_not_fall_is_said() -> None:
    run = solved("radiation_to_sink")
    held = split_burn_in(run.case.record, None)
    readings = predict(
        run.loop.before_model, held
    )  # the declared model's own: as if somebody had mended the spacecraft
    sensors = dict(zip(run.case.spec.sensors, readings.predicted_K.T, strict=True))
    record = run.case.record.take(np.arange(run.case.record.time_s.size) >= held.lead.time_s.size)
    mended = replace(record, values={**record.values, **sensors})
    report = close_loop(run.case.spec, [run.case.record], holdout_records=[mended]).report
    assert report["findings"] and report["after"]["rmse_K"] > report["before"]["rmse_K"]
    assert "did not fall" in report["notices"][0]
    assert not any("did not fall" in notice for notice in run.report["notices"])
