"""Held readings: the repeats of a slow sensor are masked and told as such, those of a resting or coarse one are not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin_core.quality import masked, quality_json
from twin_core.quality.held import held_repeats
from twin_core.telemetry import Record


def orbit(n_times: int, noise_K: float, seed: int) -> np.ndarray:
    """Return a swinging temperature with noise, (n_times,)."""
    at = np.arange(n_times)
    truth = 290.0 + 6.0 * np.sin(2.0 * np.pi * at / 95.0) + 2.0 * np.sin(at / 400.0)
    return truth + np.random.default_rng(seed).normal(0.0, noise_K, n_times)


def rows(n_times: int) -> np.ndarray:
    return 60.0 * np.arange(n_times)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    period=st.integers(2, 20),
    phase=st.integers(0, 19),
    step_K=st.sampled_from([0.0, 1e-3, 0.05]),
    lost=st.sampled_from([0.0, 0.02]),
)
def test_of_a_sensor_sampled_every_few_rows_each_reading_stays_once(
    seed: int, period: int, phase: int, step_K: float, lost: float
) -> None:
    own = orbit(1200, 0.2, seed)
    if step_K:
        own = np.round(own / step_K) * step_K
    first = (np.arange(1200) + phase) // period * period - phase
    column = own[np.maximum(first, 0)]
    column[np.random.default_rng(seed).random(1200) < lost] = np.nan
    found = held_repeats(column)
    present = np.isfinite(column)
    sampled = (np.arange(1200) + phase) % period == 0
    repeats = np.zeros(1200, dtype=bool)
    repeats[present] = np.diff(column[present], prepend=np.nan) == 0.0
    assert not found[~repeats].any()
    assert found[present & ~sampled].mean() > 0.9  # neighbouring readings may share a code


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), ratio=st.floats(2.3, 9.7))
def test_rows_need_not_divide_the_interval_of_the_sensor(seed: int, ratio: float) -> None:
    own = orbit(1200, 0.1, seed)
    last = np.floor(np.arange(int(1200 * 0.9 * ratio)) / ratio).astype(int)
    column = own[last]
    found = held_repeats(column)
    assert found.sum() == column.size - np.unique(last).size


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), band_K=st.sampled_from([0.5, 1.0]))
def test_of_a_sensor_that_reports_a_change_only_the_reports_stay(seed: int, band_K: float) -> None:
    column = orbit(1200, 0.1, seed)
    for i in range(1, 1200):
        if abs(column[i] - column[i - 1]) < band_K:
            column[i] = column[i - 1]
    found, reports = held_repeats(column), np.diff(column, prepend=np.nan) != 0.0
    assert not found[reports].any()
    assert found[~reports].mean() > 0.98


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    step_K=st.sampled_from([1e-3, 0.1, 0.5, 1.0, 2.0]),
    noise_K=st.sampled_from([0.0, 0.02, 0.1, 0.3]),
    slow=st.sampled_from([1.0, 0.1]),
)
def test_what_rests_within_a_code_is_not_held(seed: int, step_K: float, noise_K: float, slow: float) -> None:
    at = np.arange(1500) * slow
    rng = np.random.default_rng(seed)
    truth = 290.0 + rng.uniform(2.0, 8.0) * np.sin(at / rng.uniform(9.0, 30.0)) + rng.normal(0.0, noise_K, at.size)
    codes = np.cumsum(step_K * rng.uniform(0.5, 1.5, 4000)) + 250.0  # of a converter that is not quite linear
    uneven = codes[np.clip(np.searchsorted(codes, truth), 0, codes.size - 1)]
    for column in (np.round(truth / step_K) * step_K, uneven):
        assert not held_repeats(column).any()


@pytest.mark.parametrize("begin", [100, 700, 1100, 1400])
def test_a_coarse_sensor_that_was_moved_once_is_not_held(begin: int) -> None:
    """An offset that is no multiple of the step interleaves the codes: the distances between them are no step then."""
    at = np.arange(1500)
    column = np.round((320.0 + 20.0 * np.sin(at / 100.0) + 2.0 * np.sin(at / 400.0)) / 0.32) * 0.32
    column[begin:] += 8.05
    assert not held_repeats(column).any()


def test_a_switched_plate_that_rests_between_leaps_is_not_held() -> None:
    """Long rests and fast transients at a fine resolution: readings last unequally long."""
    leaps = np.concatenate(
        [np.linspace(290.0, 300.0, 10), np.full(40, 300.0), np.linspace(300.0, 290.0, 10), np.full(55, 290.0)]
    )
    assert not held_repeats(np.tile(leaps, 8)).any()


def test_a_freeze_of_a_held_sensor_is_told_as_frozen() -> None:
    column = np.repeat(orbit(400, 0.1, 3), 5)
    column[700:1000] = column[699]
    record = masked(Record(rows(column.size), {"T": column}), {"T": "K"})
    told = {row["reason"]: row for row in quality_json([record])}
    assert told["held"]["spans"] == 1 and told["held"]["samples"] >= 4 * 400
    assert told["frozen"]["samples"] == pytest.approx(300 / (5 * np.log2(400)), abs=1)  # once in the longest hold


def test_what_an_input_holds_it_may_be_meant_to() -> None:
    column = np.repeat(orbit(200, 0.1, 4), 6)
    record = Record(rows(column.size), {"T": column, "T_room": column})
    clean = masked(record, {"T": "K", "T_room": "K"}, inputs=("T_room",))
    assert {flaw.channel for flaw in clean.flaws or ()} == {"T"}
