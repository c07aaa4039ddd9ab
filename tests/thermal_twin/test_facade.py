"""The twin from Python: data frames in and out in the channels' own units, and every function once."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import thermal_twin as tt

CAPACITY, CONDUCTANCE, WALL_C = 500.0, 0.8, 15.0


def data() -> dict[str, Any]:
    return {
        "twin": "cup",
        "boundaries": {"wall": {"channel": "T_wall"}},
        "channels": {
            "T_cup": {"kind": "temperature", "unit": "degC"},
            "T_wall": {"kind": "temperature", "unit": "K"},
            "Q": {"kind": "power", "unit": "W"},
        },
        "nodes": [{"id": "cup", "sensor": "T_cup", "capacity_J_per_K": {"guess": 300.0}}],
        "conductors": [{"between": ["cup", "wall"], "conductance_W_per_K": {"guess": 1.5}}],
        "loads": [{"channel": "Q", "node": "cup"}],
    }


def frame(index: Any = None) -> pd.DataFrame:
    """Return the closed form of a cup that is heated and left alone in turn, with noise of 0.02 K."""
    time_s = np.arange(0.0, 12_000.0, 30.0)
    heat = np.where(time_s % 4000.0 < 2000.0, 8.0, 0.0)
    decay, temperature = np.exp(-30.0 * CONDUCTANCE / CAPACITY), [20.0]
    for q in heat[:-1]:
        rest = WALL_C + q / CONDUCTANCE
        temperature.append(rest + (temperature[-1] - rest) * decay)
    read = np.array(temperature) + np.random.default_rng(0).normal(0.0, 0.02, time_s.size)
    columns = {"T_cup": read, "T_wall": WALL_C + 273.15, "Q": heat, "comment": "x"}
    return pd.DataFrame(columns, index=time_s if index is None else index)


@pytest.fixture
def spec(tmp_path: Path) -> tt.TwinSpec:
    import yaml

    path = tmp_path / "cup.yaml"
    path.write_text(yaml.safe_dump(data()))
    found = tt.read(path)
    assert isinstance(found, tt.TwinSpec)
    return found


INDICES = {
    "naive": pd.date_range("2026-03-01", periods=400, freq="30s"),
    "zone": pd.date_range("2026-03-01 01:00", periods=400, freq="30s", tz="Europe/Berlin"),
    "microseconds": pd.date_range("2026-03-01", periods=400, freq="30s", unit="us"),
    "text": [f"2026-03-01T{h:02d}:{m:02d}:{s:02d}Z" for h in range(4) for m in range(60) for s in (0, 30)][:400],
}


@pytest.mark.parametrize("index", INDICES.values(), ids=list(INDICES))
def test_a_frame_becomes_a_record_and_a_frame_again(spec: tt.TwinSpec, index: Any) -> None:
    given = frame(index)
    record = tt.Record.from_dataframe(given, spec)
    assert record.present(0.0) == "2026-03-01T00:00:00Z"
    assert record.values["T_cup"].mean() == pytest.approx(given["T_cup"].mean() + 273.15)
    assert record.values["T_wall"][0] == pytest.approx(WALL_C + 273.15)
    assert any("comment" in notice for notice in record.notices)
    back = record.to_dataframe()
    assert (back.index == INDICES["naive"].tz_localize("UTC")).all()
    np.testing.assert_allclose(back["T_cup"], given["T_cup"])


def test_rows_out_of_order_are_the_same_record(spec: tt.TwinSpec) -> None:
    given = frame(INDICES["zone"])
    record, shuffled = (tt.Record.from_dataframe(f, spec) for f in (given, given.sample(frac=1.0, random_state=0)))
    assert shuffled.epoch_ns == record.epoch_ns
    np.testing.assert_array_equal(shuffled.time_s, record.time_s)
    np.testing.assert_array_equal(shuffled.values["T_cup"], record.values["T_cup"])


def test_an_index_of_words_is_refused_in_one_line(spec: tt.TwinSpec) -> None:
    with pytest.raises(tt.TwinError, match=r"^[^\n]+neither instants nor seconds[^\n]+$"):
        tt.Record.from_dataframe(frame([f"sample {i}" for i in range(400)]), spec)


def test_seconds_stay_seconds(spec: tt.TwinSpec) -> None:
    by_column = frame().rename_axis("time_s").reset_index()
    for given in (frame(), by_column, frame(pd.to_timedelta(frame().index, unit="s"))):
        record = tt.Record.from_dataframe(given, spec)
        assert record.epoch_ns is None and record.time_s[1] == 30.0
    assert "400 samples" in repr(record) and len(repr(record)) < 200


def test_a_part_of_a_record_and_one_that_was_read_know_their_units(spec: tt.TwinSpec, tmp_path: Path) -> None:
    path = tmp_path / "cup.csv"
    frame(INDICES["zone"]).drop(columns="comment").to_csv(path, index_label="time")
    record = tt.read(path, spec)
    assert isinstance(record, tt.Record)
    part = record.between(3000.0, 6000.0).to_dataframe()
    assert part.shape == (100, 3)
    np.testing.assert_allclose(part["T_wall"], WALL_C + 273.15)
    np.testing.assert_allclose(part["T_cup"], frame()["T_cup"].to_numpy()[100:200])


def test_what_is_wrong_is_one_line(spec: tt.TwinSpec) -> None:
    with pytest.raises(tt.TwinError, match="channel 'Q' is missing"):
        tt.Record.from_dataframe(frame().drop(columns="Q"), spec)
    with pytest.raises(tt.TwinError, match="'T_cup' holds what is no number"):
        tt.Record.from_dataframe(frame().assign(T_cup="warm"), spec)
    with pytest.raises(tt.TwinError, match="neither instants nor seconds"):
        tt.Record.from_dataframe(frame([f"row {i}" for i in range(400)]), spec)


def test_the_whole_way(spec: tt.TwinSpec, tmp_path: Path) -> None:
    record = tt.Record.from_dataframe(frame(INDICES["naive"]), spec)
    model = tt.calibrate(spec, record)
    assert model.values["G:cup|wall"] == pytest.approx(CONDUCTANCE, rel=0.01)
    assert model.values["C:cup"] == pytest.approx(CAPACITY, rel=0.01)
    again = tt.read(tt.save(model, tmp_path / "model.json"))
    assert isinstance(again, tt.CalibratedModel) and again.values == model.values
    assert "2 calibrated parameters" in repr(model)
    path = tt.simulate(model, record)
    assert np.sqrt(np.mean((path["cup"] - frame()["T_cup"].to_numpy()) ** 2)) < 0.05
    warm = tt.simulate(spec, frame(INDICES["naive"]), start={"cup": 90.0})
    assert warm["cup"].iloc[0] == pytest.approx(90.0)
    ahead = tt.forecast(model, record, "1h")
    assert list(ahead.columns) == [("T_cup", q) for q in ("mean", "q05", "q50", "q95")]
    assert ahead.index[0] > INDICES["naive"][-1].tz_localize("UTC")
    assert (ahead["T_cup", "q05"] < ahead["T_cup", "q95"]).all() and ahead.to_numpy().max() < 60.0
    with pytest.raises(tt.TwinError, match="no duration"):
        tt.forecast(model, record, "soon")


def test_the_loop_and_its_plot(spec: tt.TwinSpec, tmp_path: Path) -> None:
    loop = tt.close_loop(spec, frame(), holdout=0.3)
    assert loop.report["verdict"] == "no_effect_supported"
    assert repr(loop).startswith("<ClosedLoop cup: no_effect_supported")
    folder = tt.save(loop, tmp_path / "loop")
    assert {path.name for path in folder.iterdir()} == {"model.json", "report.json", "report.html"}
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    axes = tt.plot(loop, frame())
    assert axes.get_ylabel() == "temperature, °C" and len(axes.lines) == 3
