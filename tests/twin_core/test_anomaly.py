"""Anomaly detection: scores against their definitions, intervals against planted faults, stretches against the whole."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from twin_core.anomaly import Interval, Thresholds
from twin_core.anomaly.detect import detect
from twin_core.anomaly.hysteresis import HOLD, TOGETHER
from twin_core.anomaly.innovations import (
    CUSUM_WINDOW,
    NIS_WINDOW,
    TREND_WINDOW,
    cusum,
    nis_score,
    slope_score,
)
from twin_core.anomaly.readings import WINDOW, excess_scores, run_scores
from twin_core.anomaly.thresholds import ALLOWANCE, CLOSE
from twin_core.errors import ModelError

STD_K = 0.5
Wave = np.ndarray[Any, Any]


def whole(z: Wave, reading: Wave | None = None, cuts: list[int] | None = None) -> tuple[dict[str, Any], list[Interval]]:
    """Run detection over sensors T0, T1, ..., in stretches that end at ``cuts``; return each interval's last word."""
    z = z.reshape(z.shape[0], -1)
    if reading is None:
        reading = np.where(np.isnan(z), np.nan, 290.0 + z + np.arange(z.shape[0])[:, None] * 0.01)
    reading = reading.reshape(z.shape)
    time = np.arange(z.shape[0], dtype=np.int64) * 10
    names = [f"T{i}" for i in range(z.shape[1])]
    state, found = None, []
    for part in np.split(np.arange(z.shape[0]), cuts or []):
        nis = np.nansum(z[part] ** 2, axis=1)
        state, some = detect(
            state, names, time[part], reading[part], z[part] * STD_K, np.full_like(z[part], STD_K), nis
        )
        found += some
    latest = {(i.sensor, i.kind, i.start): i for i in found}
    return state or {}, list(latest.values())


def noise(seed: int, *shape: int) -> Wave:
    return np.random.default_rng(seed).normal(size=shape)


def test_scores_follow_their_definitions() -> None:
    z = noise(0, 300)
    k = 250
    last = z[k - NIS_WINDOW + 1 : k + 1]
    expected = stats.norm.isf(stats.chi2.sf((last**2).sum(), NIS_WINDOW))
    assert nis_score(z**2, np.ones(300))[k] == pytest.approx(expected, abs=0.02)  # the cube root is that good
    place = np.arange(TREND_WINDOW)
    fit = stats.linregress(place, z[k - TREND_WINDOW + 1 : k + 1])
    spread = 1.0 / np.sqrt(((place - place.mean()) ** 2).sum())  # of the slope where the noise is one
    assert slope_score(z)[k] == pytest.approx(abs(fit.slope) / spread)
    sums = [z[k - n + 1 : k + 1].sum() for n in range(1, CUSUM_WINDOW + 1)]
    rises = [abs(total) - ALLOWANCE * n for n, total in enumerate(sums, start=1)]
    assert cusum(z)[k] == pytest.approx(max(0.0, *rises))
    assert cusum(z[:30])[29] == pytest.approx(cusum(z)[29])


def test_the_cusum_keeps_its_run_length() -> None:
    """Page's recursion, simulated sample by sample, alarms as seldom as Siegmund's approximation says."""
    threshold = Thresholds(1e-4).cusum
    rng, n_lanes, n_steps = np.random.default_rng(1), 2000, 3000
    level, alarms = np.zeros((2, n_lanes)), 0
    for _ in range(n_steps):
        z = rng.normal(size=n_lanes)
        level = np.maximum(level + np.stack([z, -z]) - ALLOWANCE, 0.0)
        out = level > threshold
        alarms += int(out.any(axis=0).sum())
        level[out] = 0.0
    assert alarms / (n_lanes * n_steps) == pytest.approx(1e-4, rel=0.2)


def test_runs_and_excess_against_the_binomial_distribution() -> None:
    hits = np.random.default_rng(2).random(5000) < 0.1
    hits[4000:4012] = True
    _, score, run = run_scores({}, hits, 0.0)
    assert run[4011] >= 12 and score[4011] > 6.0
    tail = stats.norm.isf(0.1 ** run[4011])  # the chance of such a run where one in ten repeats
    assert score[4011] == pytest.approx(tail, rel=0.12)
    dense = np.random.default_rng(3).random(1000) < 0.1
    dense[600:660] = np.arange(60) % 2 == 0
    _, score = excess_scores({}, dense, 0.0)
    exact = stats.norm.isf(stats.binom.sf(29, WINDOW, np.mean(dense[:600])))
    assert score[659] == pytest.approx(exact, rel=0.06)


@pytest.mark.statistical
def test_healthy_sensors_raise_no_alarm() -> None:
    z = noise(4, 100_000, 3)
    coarse = np.round(290.0 + 0.3 * np.sin(np.arange(100_000) / 30.0)[:, None] + STD_K * z, 1)
    assert whole(z)[1] == []
    assert whole(z, coarse)[1] == []


@pytest.mark.parametrize(
    ("fault", "latest"), [("bias", 30), ("small bias", 120), ("noise", 20), ("ramp", 100), ("spike", 1)]
)
def test_a_fault_of_the_residual_is_one_interval(fault: str, latest: int) -> None:
    z = noise(5, 3000)
    during = slice(1000, 1001 if fault == "spike" else 1400)
    ramp = np.arange(400) * 0.02
    z[during] += {"bias": 2.0, "small bias": 0.9, "noise": 0.0, "ramp": ramp, "spike": 30.0}[fault]
    if fault == "noise":
        z[during] *= 3.0
    _, found = whole(z)
    assert [(i.sensor, i.kind) for i in found] == [("T0", "residual")]
    assert 10_000 <= found[0].start < 10_000 + 10 * latest
    assert found[0].stop is not None and found[0].stop <= 10 * (during.stop + TREND_WINDOW)
    assert found[0].score > Thresholds().open > CLOSE


def test_sensors_that_are_stuck_coarse_or_gone() -> None:
    z = noise(6, 4000)
    reading = 290.0 + np.sin(np.arange(4000) / 15.0) + 0.05 * z
    stuck, coarse, gone = reading.copy(), reading.copy(), reading.copy()
    stuck[2000:2100] = stuck[1999]
    coarse[2000:2200] = np.round(coarse[2000:2200] * 4.0) / 4.0
    gone[2000:2100] = np.nan
    expected = {"stuck": (stuck, 2100), "quantised": (coarse, 2200), "dropout": (gone, 2100)}
    for kind, (column, stop) in expected.items():
        values = np.where(np.isnan(column), np.nan, 0.0 * z)  # the residual says nothing
        found = [i for i in whole(values, column)[1] if i.kind == kind]
        assert len(found) == 1, kind
        assert 20_000 < found[0].start <= 20_000 + 10 * 60
        assert found[0].stop is not None and found[0].stop < 10 * (stop + WINDOW)


def test_a_sensor_that_reads_rarely_or_never_is_not_missed() -> None:
    z = noise(7, 3000, 3)
    z[np.arange(3000) % 10 != 0, 0] = np.nan
    z[:, 1] = np.nan
    assert whole(z)[1] == []


def test_a_sensor_that_never_moved_is_not_stuck() -> None:
    z = noise(13, 3000)
    assert whole(z, np.full(3000, 290.0))[1] == []


def test_small_signs_in_every_sensor_add_up() -> None:
    z = noise(8, 2000, 12)
    z[1000:1060] *= 1.3
    _, found = whole(z)
    first = min(found, key=lambda i: i.start)
    assert (first.sensor, first.kind) == (TOGETHER, "joint")
    loud = noise(8, 2000, 12)
    loud[1000:1100, 3] += 6.0
    assert {i.sensor for i in whole(loud)[1]} == {"T3"}


def test_an_ongoing_fault_has_no_end() -> None:
    z = noise(9, 500)
    z[300:] += 5.0
    assert [interval.stop for interval in whole(z)[1]] == [None]


@pytest.mark.parametrize("cuts", [[1], [305, 306, 307], list(range(1, 600)), [450, 480]])
def test_stretches_give_what_the_whole_gives(cuts: list[int]) -> None:
    z = noise(10, 600, 2)
    reading = 290.0 + np.round(z, 2)
    z[300:350, 0] += 4.0
    z[450, 1] = 1e9
    z[100:130, 1] = np.nan
    reading[500:530, 0] = 291.0
    reading[np.isnan(z)] = np.nan
    state, found = whole(z, reading)
    state_cut, found_cut = whole(z, reading, cuts)
    ends = [sorted((i.sensor, i.kind, i.start, i.stop) for i in some) for some in (found, found_cut)]
    assert ends[0] == ends[1] and {i.kind for i in found} >= {"residual", "stuck", "dropout"}
    scores = [sorted(i.score for i in some) for some in (found, found_cut)]
    np.testing.assert_allclose(*scores, rtol=1e-6)
    assert state_cut["sensors"]["T0"].keys() == state["sensors"]["T0"].keys()


def test_missing_samples_are_passed_over() -> None:
    z = noise(11, 400)
    z[100:103] = np.nan
    assert whole(z)[1] == []
    assert whole(np.full(50, np.nan))[1] == []


def test_it_closes_after_enough_quiet_samples() -> None:
    z = np.zeros(200)
    z[50] = 100.0
    reading = noise(12, 200)
    _, found = whole(z, reading)
    assert len(found) == 1
    last_loud = 50 + NIS_WINDOW - 1
    assert found[0].stop == last_loud * 10
    _, open_still = whole(z[: last_loud + HOLD], reading[: last_loud + HOLD])
    assert open_still[0].stop is None


@pytest.mark.parametrize("rate", [0.0, -1.0, 0.5, float("nan")])
def test_a_rate_without_room_for_hysteresis_is_refused(rate: float) -> None:
    with pytest.raises(ModelError, match="false_alarm_rate"):
        Thresholds(rate)


def test_a_seldom_alarm_needs_more() -> None:
    rates = [1e-4, 1e-6, 1e-8]
    assert sorted(rates, key=lambda r: Thresholds(r).open) == rates
    assert sorted(rates, key=lambda r: Thresholds(r).cusum) == rates
    assert Thresholds(1e-6).open == pytest.approx(stats.norm.isf(1e-6))
