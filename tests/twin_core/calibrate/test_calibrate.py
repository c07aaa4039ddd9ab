"""Calibration from end to end: known networks come back, with a stated uncertainty that covers their truth."""

import json
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from tests.analytic import laplacian, linear_states
from tests.helpers import record_of
from twin_core.calibrate import CalibratedModel, calibrate
from twin_core.errors import Cancelled, ModelError, TelemetryError
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

CAPACITY = np.array([4.0e3, 7.0e3])
CONDUCTANCE, WALL_W_PER_K, ROOM_K, NOISE_K = 2.5, 0.9, 285.0, 0.1
TRUTH = {"C:a": CAPACITY[0], "C:b": CAPACITY[1], "G:a|b": CONDUCTANCE, "G:b|room": WALL_W_PER_K}
STEP_S = 90.0


def declared() -> dict[str, Any]:
    """Two nodes, the second of them tied to a room, the first one heated."""
    return {
        "twin": "pair",
        "boundaries": {"room": {"value_K": ROOM_K}},
        "channels": {
            "T_a": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K},
            "T_b": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K},
            "Q": {"kind": "power", "unit": "W"},
        },
        "nodes": [
            {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 6.0e3}},
            {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"guess": 5.0e3}},
        ],
        "conductors": [
            {"between": ["a", "b"], "conductance_W_per_K": {"guess": 1.5}},
            {"between": ["b", "room"], "conductance_W_per_K": {"guess": 1.5}},
        ],
        "loads": [{"channel": "Q", "node": "a"}],
    }


def heat_W(n_times: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(100 + seed)
    return np.repeat(rng.choice([0.0, 25.0, 60.0], n_times // 12 + 1), 12)[:n_times]


def exact_K(heat: np.ndarray, time_s: np.ndarray, start_K: tuple[float, float] = (290.0, 288.0)) -> np.ndarray:
    """Return the true temperatures under a heat into node a, by the matrix exponential."""
    rates = -(laplacian(2, [(0, 1)], [CONDUCTANCE]) + np.diag([0.0, WALL_W_PER_K])) / CAPACITY[:, None]
    drive = np.stack([heat, np.full(heat.size, WALL_W_PER_K * ROOM_K)], axis=1) / CAPACITY
    return linear_states(rates, drive, np.array(start_K), time_s)


def telemetry(n_times: int = 300, seed: int = 0, **more: np.ndarray) -> Record:
    rng = np.random.default_rng(seed)
    time_s, heat = STEP_S * np.arange(n_times), heat_W(n_times, seed)
    read = exact_K(heat, time_s) + rng.normal(0.0, NOISE_K, (n_times, 2))
    return record_of(time_s, **({"Q": heat, "T_a": read[:, 0], "T_b": read[:, 1]} | more))


def scores(model: CalibratedModel, truth: dict[str, float]) -> dict[str, float]:
    """Return (ln estimate - ln truth) over its stated standard deviation."""
    std = dict(zip(model.free_names, np.sqrt(np.diag(model.covariance)), strict=True))
    return {name: float(np.log(model.values[name] / value) / std[name]) for name, value in truth.items()}


@pytest.mark.statistical
def test_the_stated_uncertainty_covers_the_truth() -> None:
    """Over seeds the squared scores of four parameters are chi-square: not too wide, not too narrow."""
    found = [scores(calibrate(load_spec(declared()), [telemetry(seed=seed)]), TRUTH) for seed in range(10)]
    pulls = np.array([list(row.values()) for row in found])
    low, high = chi2.ppf([0.0005, 0.9995], pulls.size)
    assert low < float((pulls**2).sum()) < high
    assert np.abs(pulls).max() < 4.0


def test_the_residual_is_the_noise() -> None:
    model = calibrate(load_spec(declared()), [telemetry(800)])
    assert model.summary["rmse_K"] == pytest.approx(NOISE_K, rel=0.08)
    assert abs(model.summary["residual_whiteness"]) < 0.1
    assert max(model.misfit_K.values()) < 0.5 * NOISE_K
    assert model.noise_K == {"T_a": NOISE_K, "T_b": NOISE_K}


def test_held_values_are_untouched() -> None:
    data = declared()
    data["nodes"][0]["capacity_J_per_K"] = {"value": 4321.0}
    data["conductors"][1]["conductance_W_per_K"] = {"value": 0.9}
    model = calibrate(load_spec(data), [telemetry()])
    assert model.values["C:a"] == 4321.0 and model.values["G:b|room"] == 0.9
    assert set(model.free_names) == {"C:b", "G:a|b"}
    rows = {row["name"]: row for row in model.summary["parameters"]}
    assert rows["C:a"]["held"] and rows["C:a"]["std"] is None
    assert not rows["C:b"]["held"] and rows["C:b"]["std"] > 0.0


def test_bounds_are_kept_where_the_truth_lies_beyond() -> None:
    data = declared()
    data["conductors"][0]["conductance_W_per_K"] = {"guess": 1.2, "bounds": [0.8, 1.5]}
    model = calibrate(load_spec(data), [telemetry()])
    assert 0.8 <= model.values["G:a|b"] <= 1.5
    assert model.values["G:a|b"] > 1.4


def test_a_percentage_is_turned_into_watts() -> None:
    data = declared()
    data["channels"]["Q"]["unit"] = "percent"
    data["loads"][0]["gain"] = {"guess": 1.0}
    data["nodes"][0]["capacity_J_per_K"] = {"value": CAPACITY[0]}  # else only ratios are told
    record = telemetry()
    percent = Record(record.time_s, {**record.values, "Q": record.values["Q"] / 0.6})
    model = calibrate(load_spec(data), [percent])
    assert model.values["gain:Q|a"] == pytest.approx(0.6, rel=0.02)


def test_a_table_over_a_channel_is_found() -> None:
    """Heat as a function of pitch that nobody knows, at given knots: hat functions."""
    data = declared()
    data["channels"]["pitch"] = {"kind": "auxiliary", "unit": "deg", "interpolation": "hold"}
    data["loads"].append({"channel": "pitch", "node": "a", "table": {"knots": [45.0, 90.0, 180.0]}})
    rng = np.random.default_rng(5)
    time_s, heat = STEP_S * np.arange(400), heat_W(400, 5)
    pitch = np.repeat(rng.uniform(45.0, 180.0, 40), 10)
    read = exact_K(heat + np.interp(pitch, [45.0, 90.0, 180.0], [5.0, 45.0, 20.0]), time_s)
    read = read + rng.normal(0.0, NOISE_K, (400, 2))
    model = calibrate(load_spec(data), [record_of(time_s, Q=heat, pitch=pitch, T_a=read[:, 0], T_b=read[:, 1])])
    found = [model.values[f"table:pitch|a[{k}]"] for k in (45, 90, 180)]
    np.testing.assert_allclose(found, [5.0, 45.0, 20.0], atol=1.0)


def test_levels_of_a_table_are_read_from_the_telemetry() -> None:
    data = declared()
    data["channels"]["mode"] = {"kind": "auxiliary", "levels": True}
    data["loads"].append({"channel": "mode", "node": "a", "table": {}})
    rng = np.random.default_rng(6)
    time_s, heat = STEP_S * np.arange(400), heat_W(400, 6)
    mode = np.repeat(rng.choice([1.0, 2.0, 7.0], 40), 10)
    extra = np.select([mode == 1.0, mode == 2.0], [0.0, 30.0], 12.0)
    read = exact_K(heat + extra, time_s) + rng.normal(0.0, NOISE_K, (400, 2))
    model = calibrate(load_spec(data), [record_of(time_s, Q=heat, mode=mode, T_a=read[:, 0], T_b=read[:, 1])])
    assert model.table_knots == {("mode", "a"): (1.0, 2.0, 7.0)}
    found = [model.values[f"table:mode|a[{k}]"] for k in (1, 2, 7)]
    np.testing.assert_allclose(found, [0.0, 30.0, 12.0], atol=1.0)


def test_a_node_that_stores_nothing_is_told_as_declared() -> None:
    """What stands for a capacity of nothing in the arithmetic is told to nobody."""
    data = declared()
    data["nodes"].append({"id": "skin", "capacity_J_per_K": {"value": 0.0}})
    data["conductors"].append({"between": ["a", "skin"], "conductance_W_per_K": {"value": 150.0}})
    model = calibrate(load_spec(data), [telemetry()])
    (row,) = [row for row in model.summary["parameters"] if row["name"] == "C:skin"]
    assert row["mean"] == 0.0 and row["held"] and model.values["C:skin"] > 0.0


def test_knots_that_the_channel_never_reaches_are_told() -> None:
    """Half of the knots lie where the channel goes: what it does not visit has no uncertainty, and disturbs no other."""
    data = declared()
    data["channels"]["pitch"] = {"kind": "auxiliary"}
    data["loads"].append({"channel": "pitch", "node": "a", "table": {"knots": [0.0, 10.0, 2e6, 3e6]}})
    rng = np.random.default_rng(8)
    time_s, heat = STEP_S * np.arange(400), heat_W(400, 8)
    pitch = np.repeat(rng.uniform(0.0, 10.0, 40), 10)
    read = exact_K(heat + 4.0 * pitch, time_s) + rng.normal(0.0, NOISE_K, (400, 2))
    model = calibrate(load_spec(data), [record_of(time_s, Q=heat, pitch=pitch, T_a=read[:, 0], T_b=read[:, 1])])
    rows = {row["name"]: row for row in model.summary["parameters"]}
    found = [rows[f"table:pitch|a[{k}]"] for k in ("0", "10")]
    np.testing.assert_allclose([row["mean"] for row in found], [0.0, 40.0], atol=1.0)
    assert all(row["std"] < 1.0 for row in found)
    for name in ("table:pitch|a[2e+06]", "table:pitch|a[3e+06]"):
        assert rows[name]["std"] is None and rows[name]["identified"] is False
        (told,) = [line for line in model.summary["words"] if name in line]
        assert "never comes near that knot" in told and told.startswith(
            f"the data do not determine {name}: channel 'pitch'"
        )
    assert np.abs(model.covariance).max() < 1.0


def test_an_unknown_sink_is_found() -> None:
    data = declared()
    data["boundaries"]["room"] = {"guess_K": 270.0}
    model = calibrate(load_spec(data), [telemetry(600)])
    assert model.values["T:room"] == pytest.approx(ROOM_K, abs=1.0)


def test_no_sink_is_colder_than_absolute_zero() -> None:
    """The meter of the heat reads 400 W too much, all else is known: the sink that balances it lies 159 K below zero."""
    data = declared()
    data["boundaries"]["room"] = {"guess_K": 250.0}
    for node, name in zip(data["nodes"], ("C:a", "C:b"), strict=True):
        node["capacity_J_per_K"] = {"value": float(TRUTH[name])}
    for conductor, name in zip(data["conductors"], ("G:a|b", "G:b|room"), strict=True):
        conductor["conductance_W_per_K"] = {"value": TRUTH[name]}
    data["loads"][0]["node"] = "b"
    time_s = STEP_S * np.arange(300)
    wrong = ROOM_K - 400.0 / WALL_W_PER_K
    assert wrong < -100.0
    read = exact_K(np.zeros(300), time_s) + np.random.default_rng(3).normal(0.0, NOISE_K, (300, 2))
    model = calibrate(load_spec(data), [record_of(time_s, Q=np.full(300, 400.0), T_a=read[:, 0], T_b=read[:, 1])])
    assert model.values["T:room"] == 0.0
    assert "T:room ends at its bound of 0 K; the data pull below it" in model.summary["words"]


def test_guesses_that_nobody_made_are_found_from_the_data() -> None:
    data = declared()
    for node in data["nodes"]:
        del node["capacity_J_per_K"]
    for conductor in data["conductors"]:
        del conductor["conductance_W_per_K"]
    model = calibrate(load_spec(data), [telemetry(500)])
    for name, value in TRUTH.items():
        assert model.values[name] == pytest.approx(value, rel=0.05), name


def test_a_node_that_nobody_reads_is_inferred() -> None:
    """The second node has no sensor: its capacity shows in the slow part of the first one's response."""
    data = declared()
    del data["nodes"][1]["sensor"], data["channels"]["T_b"]
    model = calibrate(load_spec(data), [telemetry(800, seed=2)])
    assert model.spec.sensors == ("T_a",)
    for name, value in TRUTH.items():
        assert model.values[name] == pytest.approx(value, rel=0.15), name


def test_segments_have_their_own_starts() -> None:
    """Two orbits a week apart: neither the gap nor the jump of the temperatures between them matters."""
    parts = []
    for seed, start in ((3, (270.0, 275.0)), (4, (310.0, 300.0))):
        time_s, heat = STEP_S * np.arange(150), heat_W(150, seed)
        read = exact_K(heat, time_s, start) + np.random.default_rng(seed).normal(0.0, NOISE_K, (150, 2))
        parts.append(record_of(time_s + seed * 6e5, Q=heat, T_a=read[:, 0], T_b=read[:, 1]))
    model = calibrate(load_spec(declared()), parts)
    assert max(abs(z) for z in scores(model, TRUTH).values()) < 4.0
    assert model.summary["train"]["segments"] == 2
    assert model.summary["train"]["samples"] == 300
    assert model.summary["rmse_K"] == pytest.approx(NOISE_K, rel=0.15)


def test_gaps_and_irregular_samples_are_no_obstacle() -> None:
    rng = np.random.default_rng(7)
    time_s, heat = STEP_S * np.arange(500), heat_W(500, 7)
    read = exact_K(heat, time_s) + rng.normal(0.0, NOISE_K, (500, 2))
    read[rng.random((500, 2)) < 0.3] = np.nan
    read[100:160] = np.nan
    keep = (rng.random(500) < 0.7) | (np.diff(heat, prepend=0.0) != 0.0)  # a switch must be seen when it happens
    model = calibrate(load_spec(declared()), [record_of(time_s, Q=heat, T_a=read[:, 0], T_b=read[:, 1]).take(keep)])
    assert max(abs(z) for z in scores(model, TRUTH).values()) < 4.0


def test_a_gap_of_a_century_divides_the_record_and_a_scrap_beyond_it_is_left_out() -> None:
    record, century_s = telemetry(), 3.2e9
    time_s = (
        record.time_s + np.where(np.arange(300) >= 150, century_s, 0.0) + np.where(np.arange(300) >= 297, century_s, 0)
    )
    halves = [record.take(np.arange(150)), Record(time_s[150:297], record.take(np.arange(150, 297)).values)]
    whole = calibrate(load_spec(declared()), [Record(time_s, record.values)])
    apart = calibrate(load_spec(declared()), halves)
    assert whole.values == apart.values


def test_excluded_intervals_take_no_part() -> None:
    """Readings within an excluded interval may be anything: the result is that of leaving them out."""
    data = declared()
    data["exclude"] = [{"start": 9000.0, "stop": 13500.0, "reason": "sensor test"}]
    record = telemetry()
    inside = (record.time_s >= 9000.0) & (record.time_s < 13500.0)
    spoilt = {**record.values, "T_a": np.where(inside, 500.0, record.values["T_a"])}
    empty = {name: np.where(inside & (name != "Q"), np.nan, column) for name, column in record.values.items()}
    with_garbage = calibrate(load_spec(data), [Record(record.time_s, spoilt)])
    left_out = calibrate(load_spec(declared()), [Record(record.time_s, empty)])
    for name in TRUTH:
        assert with_garbage.values[name] == pytest.approx(left_out.values[name], rel=1e-6)


@pytest.mark.parametrize("channel", ["Q", "T_a", "T_b"])
def test_a_channel_without_samples_is_named(channel: str) -> None:
    record = telemetry(100, **{channel: np.full(100, np.nan)})
    with pytest.raises(TelemetryError, match=rf"record: channel '{channel}' has no (usable )?samples"):
        calibrate(load_spec(declared()), [record])


def test_too_little_telemetry_is_refused() -> None:
    with pytest.raises(TelemetryError, match="fewer than three usable samples"):
        calibrate(load_spec(declared()), [telemetry(2)])
    with pytest.raises(TelemetryError, match="no telemetry"):
        calibrate(load_spec(declared()), [])


def test_a_resting_spacecraft_is_answered_in_words() -> None:
    """Constant heat and temperatures tell nothing of capacities: no NaN, but a plain statement."""
    rest_K = ROOM_K + 30.0 / WALL_W_PER_K
    rng = np.random.default_rng(0)
    readings = {
        "T_b": rest_K + rng.normal(0, NOISE_K, 200),
        "T_a": rest_K + 30.0 / CONDUCTANCE + rng.normal(0, NOISE_K, 200),
    }
    model = calibrate(load_spec(declared()), [record_of(STEP_S * np.arange(200), Q=30.0, **readings)])
    json.dumps(model.to_json(), allow_nan=False)
    said = " ".join(model.summary["words"])
    assert "C:a" in said and "C:b" in said
    assert model.values["G:a|b"] == pytest.approx(CONDUCTANCE, rel=0.1)


def test_noise_free_constants_are_no_accident() -> None:
    record = record_of(STEP_S * np.arange(50), Q=0.0, T_a=ROOM_K, T_b=ROOM_K)
    model = calibrate(load_spec(declared()), [record])
    json.dumps(model.to_json(), allow_nan=False)
    assert model.summary["rmse_K"] < 1e-2


def test_progress_runs_from_start_to_end_and_can_cancel() -> None:
    heard: list[tuple[float, str]] = []
    calibrate(load_spec(declared()), [telemetry(100)], progress=lambda f, m: heard.append((f, m)))
    fractions = [f for f, _ in heard]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0 and all(message for _, message in heard)

    def stop(fraction: float, message: str) -> None:
        if fraction > 0.3:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        calibrate(load_spec(declared()), [telemetry(100)], progress=stop)


def test_an_unknown_method_is_named() -> None:
    with pytest.raises(ModelError, match="unknown calibration method 'magic' \\(known: second-order"):
        calibrate(load_spec(declared()), [telemetry(50)], method="magic")
