"""What a report to sign holds, against what can be worked out by hand."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from twin_core.calibrate.second_order import fit_trajectories
from twin_core.calibrate.statistics import spread_of
from twin_core.calibrate.summary import to_model
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.errors import TelemetryError
from twin_core.holdout import Prediction
from twin_core.network.spec_io import load_spec
from twin_core.report.dossier import Moment, check_moments, heat_flow_maps, histograms, provenance, sensitivity
from twin_core.report.html import render
from twin_core.report.network_picture import draw_flows
from twin_core.report.residual_picture import draw_residuals
from twin_core.telemetry import Record

SPEC = load_spec(
    {
        "twin": "one",
        "boundaries": {"room": {"value_K": 290.0}},
        "channels": {"T": {"kind": "temperature", "unit": "K", "noise_std": 0.05}, "Q": {"kind": "power", "unit": "W"}},
        "nodes": [{"id": "a", "sensor": "T", "capacity_J_per_K": {"guess": 900.0}}],
        "conductors": [{"between": ["a", "room"], "conductance_W_per_K": {"guess": 1.2}}],
        "loads": [{"channel": "Q", "node": "a"}],
    }
)


BARE = {"twin": "t", "verdict": "unexplained", "before": {"rmse_K": 1.0}, "after": {"rmse_K": 1.0}}


def resting(heat_W: float = 20.0) -> Record:
    """One node at rest: its temperature is that of the room and Q / G beyond it, with G = 2 W/K."""
    time_s = np.arange(0.0, 40_000.0, 100.0)
    noise = np.random.default_rng(3).normal(0.0, 0.05, time_s.size)
    return Record(time_s, {"T": 290.0 + heat_W / 2.0 + noise, "Q": np.full(time_s.size, heat_W)}, name="rest")


def test_sensitivity_at_rest_is_that_of_ohms_law() -> None:
    """d(Q/G) = -(Q/G) d ln G: 10 % more conductance moves 10 K by 0.953 K to first order, and the capacity moves nothing."""
    matrix = sensitivity(fit_trajectories(SPEC, [resting()]))
    rows = {row["parameter"]: row for row in matrix["rows"]}
    assert matrix["sensors"] == ["T"]
    # The initial temperature is held, so the first minutes, a fortieth of the record, move less.
    assert rows["G:a|room"]["rms_K"][0] == pytest.approx(10.0 * np.log(1.1), rel=0.05)
    assert rows["C:a"]["rms_K"][0] < 0.02
    assert rows["G:a|room"]["change"] == "+10%"


def test_heat_flows_at_chosen_moments_are_those_of_the_load() -> None:
    """A node that has settled passes on what it is given: 20 W, then 60 W, and 40 W on average over both."""
    slow_s = 4_000.0
    time_s = np.arange(0.0, 20.0 * slow_s, 100.0)
    heat = np.where(time_s < 10.0 * slow_s, 20.0, 60.0)
    temperature = np.where(time_s < 10.0 * slow_s, 300.0, 320.0 - 20.0 * np.exp(-(time_s - 10.0 * slow_s) / 450.0))
    noise = np.random.default_rng(3).normal(0.0, 0.05, time_s.size)
    record = Record(time_s, {"T": temperature + noise, "Q": heat}, name="steps")
    fit = fit_trajectories(SPEC, [record])
    search: Any = SimpleNamespace(trial=SimpleNamespace(calibration=lambda: fit))
    moments: list[Moment] = [(8.0 * slow_s, 8.0 * slow_s), (18.0 * slow_s, 18.0 * slow_s), (0.0, 20.0 * slow_s - 100.0)]
    check_moments([record], moments)
    early, late, mean = heat_flow_maps(search, to_model(fit, ()), moments)
    for found, watt in ((early, 20.0), (late, 60.0)):
        (link,), (load,) = found["links"], found["loads"]
        assert load["heat_W"] == pytest.approx(watt) and abs(link["heat_W"]) == pytest.approx(watt, abs=0.05)
        assert found["phase"] == "chosen moment" and found["start"] == found["stop"]
    assert mean["loads"][0]["heat_W"] == pytest.approx(40.0, abs=0.2) and mean["phase"].endswith("chosen phase")
    assert [found["start"] for found in (early, late)] == [8.0 * slow_s, 18.0 * slow_s]
    (switched,) = heat_flow_maps(search, to_model(fit, ()), [(10.0 * slow_s, 10.0 * slow_s)])
    assert switched["start"] == 10.0 * slow_s and switched["loads"][0]["heat_W"] == pytest.approx(60.0)
    with pytest.raises(TelemetryError, match=r"heat flows at 90000.0: no segment .* \(0.0 to 79900.0\)"):
        check_moments([record], [(9e4, 9e4)])
    with pytest.raises(TelemetryError, match="counts seconds"):
        check_moments([record], [("2026-03-01T00:00:00Z", "2026-03-01T00:00:00Z")])
    with pytest.raises(TelemetryError, match="is dated; write a date"):
        check_moments([replace(record, epoch_ns=0)], [(5.0, 5.0)])


def test_quantiles_of_a_known_spread() -> None:
    found = spread_of(np.linspace(-1.0, 3.0, 401))
    assert found["q50_K"] == pytest.approx(1.0) and found["bias_K"] == pytest.approx(1.0)
    assert found["q01_K"] == pytest.approx(-0.96) and found["q99_K"] == pytest.approx(2.96)
    assert found["max_abs_K"] == 3.0


def test_hashes_follow_every_sample_and_no_order_of_columns() -> None:
    record = resting()
    first = provenance(SPEC, [record])
    assert first == provenance(SPEC, [Record(record.time_s, dict(reversed(record.values.items())), name="rest")])
    changed = dict(record.values) | {"T": record.values["T"] + np.eye(1, record.time_s.size, 7)[0] * 1e-12}
    other = provenance(SPEC, [Record(record.time_s, changed, name="rest")])
    assert other["telemetry"][0]["sha256"] != first["telemetry"][0]["sha256"]
    assert other["specification_sha256"] == first["specification_sha256"]
    assert len(first["specification_sha256"]) == 64 and "numpy" in first["versions"]


def test_histograms_count_every_reading_once() -> None:
    rng = np.random.default_rng(0)
    measured = rng.normal(280.0, 1.0, (500, 1))
    measured[:20] = np.nan
    tables = [[Prediction(np.arange(500.0), measured, np.full((500, 1), guess))] for guess in (281.0, 280.0)]
    found = histograms(SPEC, (tables[0], tables[1]))["T"]
    assert sum(found["before"]) == sum(found["after"]) == 480
    assert len(found["edges_K"]) == len(found["after"]) + 1


def test_residuals_are_drawn_with_noise_and_limit() -> None:
    time = np.arange(50.0)
    series = {"measured": list(np.sin(time)), "before": [0.0] * 50, "after": [None, *np.sin(time[1:])]}
    shown = [True] * 50
    near = draw_residuals(series, shown, {}, {"noise_K": 0.1, "q99_abs_K": 1.2}, ("<start>", "stop"))
    assert near.count('class="limit"') == 2 and 'class="noise"' in near and "&lt;start&gt;" in near
    far = draw_residuals(series, shown, {}, {"noise_K": 0.1, "q99_abs_K": 12.0}, ("a", "b"))
    assert 'class="limit"' not in far and "limit ±12 K, beyond this picture" in far
    assert draw_residuals(series, [False] * 50, {}, {}, ("a", "b")) == ""


def test_heat_goes_where_the_arrow_points() -> None:
    flows = {
        "nodes": [{"id": "a", "temperature_K": 300.0}, {"id": "b", "temperature_K": 310.0}],
        "boundaries": [{"id": "space", "temperature_K": 3.0}],
        "links": [
            {"kind": "conductor", "ends": ["a", "b"], "heat_W": -20.0},
            {"kind": "radiator", "ends": ["a", "space"], "heat_W": SIGMA * 0.1 * 300.0**4},
        ],
        "loads": [{"channel": "Q", "node": "b", "heat_W": 20.0}],
        "heaters": [],
        "effects": [],
    }
    picture = draw_flows(flows)
    assert "20.0 W" in picture and "45.9 W" in picture and "310.0 K, loads 20.0 W" in picture
    page = render(BARE | {"heat_flows": [flows | {"phase": "now", "start": 0, "stop": 0}]}, {})
    assert "<tr><td>conductor</td><td>b</td><td>a</td>" in page


def test_who_signs_stands_on_the_page() -> None:
    page = render(BARE | {"document": {"date": "2026-02-03", "author": "A. <B>", "files": []}}, {})
    assert "A. &lt;B&gt;" in page and "2026-02-03" in page and "approved" in page
