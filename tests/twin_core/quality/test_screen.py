"""Planted faults in synthetic telemetry: found where they are, and nowhere else."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin_core.quality import masked, quality_json, quality_strip, screen, unmasked
from twin_core.telemetry import Record

DATA = Path(__file__).parents[4] / "shared" / "data"
UNITS = {"T_a": "K", "T_b": "degC", "T_c": "K", "Q": "W"}


def healthy(seed: int, n_times: int = 1200, step_K: float = 0.1, noise_K: float = 0.1) -> dict[str, np.ndarray]:
    """Return three temperatures that drift and swing, with noise, in steps; and a heater that is switched."""
    rng = np.random.default_rng(seed)
    at = np.arange(n_times)
    columns = {}
    for k, name in enumerate(("T_a", "T_b", "T_c")):
        truth = 290.0 + 6.0 * np.sin(2.0 * np.pi * at / (90.0 + 25.0 * k) + k) + 2.0 * np.sin(at / 400.0)
        columns[name] = np.round((truth + rng.normal(0.0, noise_K, n_times)) / step_K) * step_K
    columns["Q"] = np.where(at // 60 % 2 == 0, 20.0, 0.0)
    return columns


def found(columns: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    time_s = 60.0 * np.arange(columns["Q"].size)
    return {name: dict(reasons) for name, reasons in screen(time_s, columns, UNITS).masks.items()}


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    step_K=st.sampled_from([1e-3, 0.1, 0.5, 1.0]),
    noise_K=st.sampled_from([0.0, 0.02, 0.3]),
)
def test_healthy_telemetry_loses_nothing(seed: int, step_K: float, noise_K: float) -> None:
    assert found(healthy(seed, step_K=step_K, noise_K=noise_K)) == {}


# Of the power of a test that chance has a part in: the same records each time.
@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), begin=st.integers(100, 900), lasting=st.integers(16, 200))
def test_frozen_rows_are_found_in_every_channel(seed: int, begin: int, lasting: int) -> None:
    columns = healthy(seed)
    for column in columns.values():
        column[begin + 1 : begin + 1 + lasting] = column[begin]
    masks = found(columns)
    for name in ("T_a", "T_b", "T_c"):
        # The first reading after the freeze may repeat by chance.
        assert lasting <= masks[name]["frozen"].sum() <= lasting + 1
        assert masks[name]["frozen"][begin + 1 : begin + 1 + lasting].all()


@pytest.mark.parametrize("present", [(), ("T_a",)])
def test_a_command_that_rests_while_temperatures_are_missing_is_a_reading(present: tuple[str, ...]) -> None:
    columns = healthy(7)
    columns["Q"] = np.where(np.arange(1200) < 600, np.random.default_rng(3).choice([0.0, 5.0, 9.0], 1200), 9.0)
    for name in {"T_a", "T_b", "T_c"} - set(present):
        columns[name][650:850] = np.nan
    assert found(columns) == {}


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), begin=st.integers(100, 900), lasting=st.integers(45, 200))
def test_one_frozen_channel_is_found_alone(seed: int, begin: int, lasting: int) -> None:
    columns = healthy(seed)
    columns["T_b"][begin + 1 : begin + 1 + lasting] = columns["T_b"][begin]
    masks = found(columns)
    assert set(masks) == {"T_b"}
    assert masks["T_b"]["frozen"][begin + 1 : begin + 1 + lasting].all()
    others = np.flatnonzero(columns["T_b"] != columns["T_b"][begin])  # readings beside the freeze may repeat by chance
    first, stop = others[others < begin].max(), others[others > begin].min()
    assert masks["T_b"]["frozen"].sum() <= stop - first - 2


@settings(max_examples=25, deadline=None)
@given(
    period=st.floats(20.0, 5000.0),
    phase=st.floats(0.0, 6.28),
    step_K=st.floats(1e-3, 2.0),
    swing_K=st.floats(0.5, 30.0),
)
def test_the_turning_points_of_a_quantised_swing_are_no_freeze(
    period: float, phase: float, step_K: float, swing_K: float
) -> None:
    """Without any noise: a sine stays in its topmost step for 2 sqrt(2 step / curvature), far longer than elsewhere."""
    truth = 290.0 + swing_K * np.sin(2.0 * np.pi * np.arange(3000) / period + phase)
    assert screen(np.arange(3000.0), {"T_a": np.round(truth / step_K) * step_K}, {"T_a": "K"}).masks == {}


@pytest.mark.parametrize(
    ("channel", "own", "at"),
    [
        ("T_a", 0.0, [500]),
        ("T_a", 0.0, list(range(300, 400))),
        ("T_a", -999.0, [5, 700]),
        ("T_b", -999.0, [3, 4, 5]),
        ("T_b", 9999.0, [0, 1]),
        ("T_b", 85.0, [0, 77]),
        ("T_b", -127.0, list(range(600, 680))),
        ("Q", -9999.0, [40]),
        ("T_b", 0.0, []),
        ("Q", 0.0, []),
    ],
)
def test_numbers_that_mean_missing(channel: str, own: float, at: list[int]) -> None:
    columns = healthy(3)
    columns[channel][at] = own + (273.15 if UNITS[channel] == "degC" else 0.0)
    masks = found(columns)
    if not at:
        assert masks == {}
        return
    assert set(masks) == {channel} and set(masks[channel]) == {"sentinel"}
    np.testing.assert_array_equal(np.flatnonzero(masks[channel]["sentinel"]), at)


def test_a_marker_that_is_proven_once_is_one_beside_a_heater_that_is_off_too() -> None:
    """A heater of 5 kW leaps farther than from 40 W to -999 W: of sixty markers it once hid most."""
    rng = np.random.default_rng(3)
    columns = healthy(3)
    columns["Q"] = np.where(rng.random(120) < 0.5, 5000.0, 40.0).repeat(10) + rng.normal(0.0, 100.0, 1200)
    at = np.sort(rng.choice(1200, 60, replace=False))
    columns["Q"][at] = -999.0
    np.testing.assert_array_equal(np.flatnonzero(found(columns)["Q"]["sentinel"]), at)


@pytest.mark.parametrize("power_W", [0.0, 85.0, 127.0, 255.0, 999.0, 4095.0])
def test_a_heater_may_be_switched_on_once(power_W: float) -> None:
    columns = healthy(4)
    columns["Q"] = np.where((np.arange(1200) > 400) & (np.arange(1200) < 500), power_W, 20.0)
    assert found(columns) == {}


def test_a_sensor_that_dies_is_frozen_to_the_end() -> None:
    columns = healthy(6)
    columns["T_c"][1101:] = columns["T_c"][1100]
    assert {name: set(reasons) for name, reasons in found(columns).items()} == {"T_c": {"frozen"}}
    np.testing.assert_array_equal(np.flatnonzero(found(columns)["T_c"]["frozen"]), np.arange(1101, 1200))


def test_a_channel_that_is_written_more_often_than_it_is_read_is_not_frozen() -> None:
    columns = {name: np.repeat(column[:300], 6) for name, column in healthy(7).items()}
    assert {reason for reasons in found(columns).values() for reason in reasons} == {"held"}


def test_a_zero_that_is_a_temperature_stays() -> None:
    """Through the freezing point, and along it."""
    columns = {"T_b": np.round(np.random.default_rng(0).normal(0.0, 0.4, 800), 1) + 273.15}
    assert screen(np.arange(800.0), columns, UNITS).masks == {}


def test_a_rail_is_told_from_a_freeze() -> None:
    rng = np.random.default_rng(1)
    truth = 290.0 + 30.0 * np.sin(2.0 * np.pi * np.arange(2000) / 400.0) + rng.normal(0.0, 0.3, 2000)
    clipped = np.minimum(np.round(truth, 1), 310.0)
    masks = screen(np.arange(2000.0), {"T_a": clipped}, {"T_a": "K"}).masks
    assert set(masks["T_a"]) == {"rail"}
    assert masks["T_a"]["rail"].sum() > 0.8 * (truth > 310.5).sum()
    assert (clipped[masks["T_a"]["rail"]] == 310.0).all()


def test_a_masked_record_says_so_and_is_left_alone_afterwards() -> None:
    columns = healthy(5)
    columns["T_a"][[300, 301, 600]] = 0.0
    record = Record(60.0 * np.arange(1200), columns)
    clean = masked(record, UNITS)
    assert np.isnan(clean.values["T_a"][[300, 301, 600]]).all() and np.isnan(clean.values["T_a"]).sum() == 3
    (notice,) = clean.notices
    assert "3 readings of 'T_a'" in notice and "first at 18000" in notice
    (row,) = quality_json([clean])
    first = row.pop("first")
    assert row == {"channel": "T_a", "reason": "sentinel", "samples": 3, "spans": 2}
    assert [span["samples"] for span in first] == [flaw.samples for flaw in clean.flaws or ()]
    assert masked(clean, UNITS) is clean
    assert quality_strip([clean]).count("<title>") == 2
    raw = unmasked(record)
    assert masked(raw, UNITS) is raw and quality_json([raw]) == [] and quality_strip([raw]) == ""


def test_a_channel_is_named_in_the_strip_as_text() -> None:
    record = Record(np.arange(40.0), {"<T>": np.where(np.arange(40) == 20, 0.0, 290.0 + 0.01 * np.arange(40) ** 1.5)})
    strip = quality_strip([masked(record, {"<T>": "K"})])
    assert "&lt;T&gt;" in strip and "<T>" not in strip


def _measured(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, str | None]]:
    frame = pd.read_csv(path)
    clock = frame.iloc[:, 0]
    if frame.columns[0] == "time":
        clock = (pd.to_datetime(clock) - pd.to_datetime(clock[0])).dt.total_seconds()
    keep = np.concatenate([[True], np.diff(clock.to_numpy()) > 0])
    names = list(frame.columns[1:])
    units: dict[str, str | None] = {name: "degC" if name.endswith("degC") else None for name in names}
    columns = {n: frame[n].to_numpy(dtype=float)[keep] + (273.15 if units[n] else 0.0) for n in names}
    return clock.to_numpy(dtype=float)[keep], columns, units


def slow_swing() -> np.ndarray:
    """Return a swing without noise that moves at most one step of 0.32 K per sample, (900,)."""
    return 318.0 + 18.0 * np.sin(2.0 * np.pi * np.arange(900) / 400.0)


@pytest.mark.parametrize(("begin", "lasting"), [(220, 100), (150, 60), (570, 80), (360, 41)])
def test_a_freeze_between_single_steps_is_told_by_the_leap_that_ends_it(begin: int, lasting: int) -> None:
    column = np.round(slow_swing() / 0.32) * 0.32
    column[begin + 1 : begin + 1 + lasting] = column[begin]
    masks = screen(np.arange(900.0), {"T_a": column}, {"T_a": "K"}).masks
    assert set(masks["T_a"]) == {"frozen"}
    frozen = masks["T_a"]["frozen"]
    assert (
        frozen[begin + 1 : begin + 1 + lasting].all() and frozen.sum() <= lasting + 4
    )  # neighbours may share the code


@pytest.mark.parametrize("what", ["offset after a rest", "spike after a rest", "gap after a turning point"])
def test_a_leap_after_a_rest_is_no_freeze(what: str) -> None:
    truth, time_s = slow_swing(), np.arange(900.0)
    if what == "gap after a turning point":
        keep = (time_s < 112) | (time_s > 200)  # the topmost step lasts from 88 to 112
        truth, time_s = truth[keep], time_s[keep]
    else:
        truth[300:] = truth[300]
        truth[400 : 900 if what.startswith("offset") else 402] += 8.0
    masks = screen(time_s, {"T_a": np.round(truth / 0.32) * 0.32}, {"T_a": "K"}).masks
    assert {reason for reasons in masks.values() for reason in reasons} <= {"spike"}


def test_one_code_that_is_known_to_be_wide_tells_of_others() -> None:
    """Of a converter every tenth code is as wide as eight: a cooling that passes 300 K once rests there too."""
    rng = np.random.default_rng(2)
    truth = np.concatenate([np.linspace(303.5, 294.0, 350), 295.0 + 3.0 * np.sin(np.arange(450) / 20.0)])
    truth = truth + rng.normal(0.0, 0.3, 800)
    nearest = np.round(truth / 2.5) * 2.5
    column = np.where(np.abs(truth - nearest) < 1.0, nearest, np.round(truth / 0.25) * 0.25)
    assert screen(np.arange(800.0), {"T_a": column}, {"T_a": "K"}).masks == {}
    frozen = np.round(truth / 0.25) * 0.25  # the same of an even converter
    frozen[121:181] = frozen[120]
    assert screen(np.arange(800.0), {"T_a": frozen}, {"T_a": "K"}).masks["T_a"]["frozen"][121:181].all()


MEASURED = sorted(DATA.glob("*/*.csv"))


@pytest.mark.skipif(not MEASURED, reason="the measured sets are not beside the repository")
def test_frozen_rows_of_the_measured_sets() -> None:
    """FUNcube-1 holds 227 rows for its ground station; one home's thermostat held 18.88 degC for 2.5 hours."""
    frozen = {}
    for path in MEASURED:
        if "flight_model" in path.name:
            continue
        for channel, reasons in screen(*_measured(path)).masks.items():
            if "frozen" in reasons or "rail" in reasons:
                frozen[path.stem, channel] = sum(int(mask.sum()) for r, mask in reasons.items() if r != "spike")
    funcube = {key: count for key, count in frozen.items() if key[0].startswith("whole_orbit")}
    assert len(funcube) == 14 and all(abs(count - 227) <= 2 for count in funcube.values())
    assert {key: count for key, count in frozen.items() if key not in funcube} == {("home_3", "T_indoor_degC"): 10}


@pytest.mark.skipif(not MEASURED, reason="the measured sets are not beside the repository")
def test_a_flight_whose_beginning_alone_is_given_loses_nothing() -> None:
    """Twelve days rest at 27.93 degC and at 22.84 degC once each; 73 days do so again and again."""
    time_s, columns, units = _measured(DATA / "chandra_psmc" / "flight_a.csv")
    temperature = {name: column[:800] for name, column in columns.items() if units[name] == "degC"}
    assert screen(time_s[:800], temperature, units).masks == {}


@pytest.mark.skipif(not MEASURED, reason="the measured sets are not beside the repository")
@pytest.mark.parametrize(("begin", "lasting"), [(200, 41), (200, 100), (250, 60), (500, 80), (600, 41)])
def test_a_freeze_planted_in_the_temperature_lab_is_found(begin: int, lasting: int) -> None:
    time_s, columns, units = _measured(DATA / "tclab_notre_dame" / "sine300s_run1.csv")
    columns["T1_degC"][begin : begin + lasting] = columns["T1_degC"][begin]
    masks = screen(time_s, columns, units).masks
    assert set(masks) == {"T1_degC"} and masks["T1_degC"]["frozen"][begin + 1 : begin + lasting].all()
