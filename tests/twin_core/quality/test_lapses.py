"""A channel that stops while the rows go on: what it does not know is not predicted, and every lapse is told."""

import numpy as np
import pytest

from tests.helpers import conductive_spec, record_of
from twin_core import closed_loop
from twin_core._typing import FloatArray
from twin_core.calibrate import calibrate
from twin_core.closed_loop import close_loop
from twin_core.errors import NoSolutionError
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.quality.gaps import without_lapses
from twin_core.telemetry import LEAST_PART, Record

STEP_S = 60.0
AT = np.arange(400)
SWITCHED = np.where(np.random.default_rng(1).random(40) < 0.5, 20.0, 0.0).repeat(10)
MISSING = np.full(400, np.nan)
ON_CHANGE = np.zeros(400, dtype=np.bool_)
ON_CHANGE[np.random.default_rng(5).choice(400, 60, replace=False)] = True
BY_DAY = np.where(AT % 100 < 30, SWITCHED, np.nan)


def between(first: int, stop: int, column: FloatArray = SWITCHED) -> FloatArray:
    """Return a channel without its samples first..stop-1."""
    return np.where((first <= AT) & (stop > AT), np.nan, column)


@pytest.mark.parametrize(
    ("channel", "kept", "told"),
    [
        (SWITCHED, [(0, 400)], 0),
        (between(150, 159), [(0, 400)], 0),
        (between(150, 210), [(0, 151), (210, 400)], 1),
        (between(0, 100), [(100, 400)], 1),
        (between(300, 400), [(0, 301)], 1),
        (between(50, 300), [(0, 51), (300, 400)], 1),
        (between(150, 210, between(230, 300)), [(0, 151), (210, 231), (300, 400)], 1),
        (between(150, 210, between(225, 300)), [(0, 151), (300, 400)], 1),
        (between(10, 395), [(0, 400)], 1),
        (between(150, 210, np.full(400, 20.0)), [(0, 400)], 1),
        (between(150, 210, 280.0 + np.sin(AT / 500.0)), [(0, 400)], 1),
        (np.where(AT % 15 == 0, SWITCHED, np.nan), [(0, 400)], 0),
        (np.where((AT % 5 == 0) & ((AT < 150) | (AT > 300)), SWITCHED, np.nan), [(0, 151), (305, 400)], 1),
        (np.where(ON_CHANGE, SWITCHED, np.nan), [(0, 400)], 0),
        (BY_DAY, [(0, 400)], 0),
        (np.where(AT == 7, 20.0, np.nan), [(0, 400)], 0),
        (np.where(np.isin(AT, (7, 300)), AT / 10.0, np.nan), [(0, 400)], 0),
        (MISSING, [(0, 400)], 0),
    ],
    ids=[
        "whole",
        "a few samples",
        "an hour",
        "missing at first",
        "stops",
        "missing for the most part",
        "two",
        "too short a part between",
        "too short everywhere",
        "constant",
        "slow",
        "a clock of its own",
        "a lapse of a clock of its own",
        "on change",
        "by day only",
        "told once",
        "told twice",
        "never there",
    ],
)
def test_rows_are_left_out_where_an_input_is_silent_and_unknown(
    channel: FloatArray, kept: list[tuple[int, int]], told: int
) -> None:
    """Of a slow clock the sample before a lapse still holds until the next one was due."""
    record = record_of(STEP_S * AT, Q=channel, T=290.0)
    parts = without_lapses([record], {"Q", "elsewhere"}, {"Q"})
    spans = [(round(part.time_s[0] / STEP_S), round(part.time_s[-1] / STEP_S) + 1) for part in parts]
    assert spans == kept
    assert [len(part.notices) for part in parts] == [told, *[0] * (len(parts) - 1)]
    assert all(part.time_s.size >= LEAST_PART for part in parts)


def test_what_might_explain_heat_is_only_told() -> None:
    record = record_of(STEP_S * AT, Q=SWITCHED, charge=between(150, 210), T=290.0)
    (part,) = without_lapses([record], {"Q", "charge"}, {"Q"})
    assert part.time_s.size == 400
    (notice,) = part.notices
    assert "channel 'charge' has no samples from 8940.0 to 12600.0" in notice and "59 rows are" in notice


@pytest.mark.parametrize(
    ("charge", "rows"),
    [
        (between(150, 210), 0),  # gone with the heater's
        (between(170, 200), 0),
        (between(150, 230), 20),
        (between(150, 210, between(300, 340)), 39),
        (between(150, 210, between(205, 217)), 7),
    ],
)
def test_rows_that_are_left_out_for_another_channel_are_not_told_to_be_bridged(charge: FloatArray, rows: int) -> None:
    record = record_of(STEP_S * AT, Q=between(150, 210), charge=charge, T=290.0)
    first, second = without_lapses([record], {"Q", "charge"}, {"Q"})
    assert first.time_s.size + second.time_s.size == 341
    told = [notice for notice in first.notices if "channel 'charge'" in notice]
    assert [f"yet {rows} rows are" in notice for notice in told] == ([True] if rows else [])
    assert all("from 17940.0 to 20400.0, and" in notice for notice in told if rows == 39)  # the lapse that is left


def heated() -> tuple[TwinSpec, Record]:
    """Return a node of 3000 J/K that loses 2 W/K to 280 K under a switched heater, and 400 minutes of it."""
    decay, temperature_K = np.exp(-2.0 * STEP_S / 3000.0), np.empty(400)
    temperature_K[0] = 285.0
    for i in range(399):
        steady_K = 280.0 + SWITCHED[i] / 2.0
        temperature_K[i + 1] = steady_K + (temperature_K[i] - steady_K) * decay
    noise_K = np.random.default_rng(2).normal(0.0, 0.02, 400)
    spec = load_spec(
        conductive_spec(
            1,
            [],
            channels={"Q": {"kind": "power", "unit": "W"}},
            boundaries={"room": {"value_K": 280.0}},
            conductors=[{"between": ["n0", "room"], "conductance_W_per_K": {"guess": 1.0}}],
            loads=[{"channel": "Q", "node": "n0"}],
        )
    )
    return spec, record_of(STEP_S * AT, T0=temperature_K + noise_K, Q=SWITCHED)


def test_a_heater_whose_samples_are_missing_does_not_spoil_the_fit() -> None:
    """Its last value was held for an hour and more: the capacity was six times too large, and nothing was said."""
    spec, record = heated()
    record.values["Q"][100:200] = np.nan
    summary = calibrate(spec, [record]).summary
    assert summary["train"]["segments"] == 2 and summary["rmse_K"] < 0.025
    capacity = next(p for p in summary["parameters"] if p["name"] == "C:n0")
    assert capacity["mean"] == pytest.approx(3000.0, rel=0.02)
    assert any("channel 'Q' has no samples" in notice for notice in summary["notices"])


def test_a_lapse_in_the_hold_out_is_told_and_not_scored() -> None:
    spec, record = heated()
    train, held = record.between(0.0, 200 * STEP_S), record.between(200 * STEP_S, 400 * STEP_S)
    held.values["Q"][60:130] = np.nan
    report = close_loop(spec, [train], holdout_records=[held]).report
    assert report["before"]["rmse_K"] < 0.03 and report["findings"] == []
    (notice,) = (notice for notice in report["notices"] if "channel 'Q' has no samples" in notice)
    assert "69 rows are left out" in notice


def test_what_is_wrong_with_the_channels_is_told_where_there_is_no_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    """A heater in milliwatts left the declared network without a heat balance, and only its loads in general were named."""
    spec, record = heated()
    inputs = {channel: 1e3 * record.values[channel] for channel in spec.driving_channels if "Q" in channel}
    assert inputs

    def fails(*_: object, **__: object) -> None:
        raise NoSolutionError("calibration failed")

    monkeypatch.setattr(closed_loop, "fit_network", fails)
    with pytest.raises(NoSolutionError, match=r"calibration failed; channel 'Q.*mW"):
        close_loop(spec, [Record(record.time_s, {**record.values, **inputs})])
