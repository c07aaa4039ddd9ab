"""Anomaly detection: scores against their definitions, intervals against planted faults, stretches against the whole."""

import numpy as np
import pytest
from scipy import stats

from twin_core.anomaly import CLOSE, HOLD, MEAN_WINDOW, NIS_WINDOW, OPEN, detect, scores


def whole(z: np.ndarray, cuts: list[int] | None = None) -> tuple[dict, list]:
    """Run detection over one sensor, in stretches that end at ``cuts``."""
    time = np.arange(z.size, dtype=np.int64) * 10
    state, found = None, []
    for part in np.split(np.arange(z.size), cuts or []):
        state, some = detect(state, ["T"], time[part], z[part, None] * 0.5, np.full((part.size, 1), 0.5))
        found += some
    latest = {interval.start: interval for interval in found}
    return state or {}, list(latest.values())


def test_scores_follow_their_definitions() -> None:
    z = np.random.default_rng(0).normal(size=200)
    got = scores(np.empty(0), z)
    k = 150
    nis = stats.norm.isf(stats.chi2.sf((z[k - NIS_WINDOW + 1 : k + 1] ** 2).sum(), NIS_WINDOW))
    mean = abs(z[k - MEAN_WINDOW + 1 : k + 1].sum()) / np.sqrt(MEAN_WINDOW)
    assert got[k] == pytest.approx(max(nis, mean), abs=0.02)  # the cube root is that good an approximation


@pytest.mark.statistical
def test_a_consistent_filter_raises_no_alarm() -> None:
    z = np.random.default_rng(1).normal(size=200_000)
    assert whole(z)[1] == []


@pytest.mark.parametrize("fault", ["bias", "noise"])
def test_a_fault_is_one_interval(fault: str) -> None:
    z = np.random.default_rng(2).normal(size=3000)
    if fault == "bias":
        z[1000:1400] += 2.0
    else:
        z[1000:1400] *= 4.0
    _, found = whole(z)
    assert len(found) == 1
    assert 10_000 <= found[0].start <= 10_000 + 10 * MEAN_WINDOW
    assert found[0].stop is not None and 13_900 <= found[0].stop <= 13_990 + 10 * MEAN_WINDOW
    assert found[0].score > OPEN > CLOSE


def test_an_ongoing_fault_has_no_end() -> None:
    z = np.random.default_rng(3).normal(size=500)
    z[300:] += 5.0
    assert [interval.stop for interval in whole(z)[1]] == [None]


@pytest.mark.parametrize("cuts", [[1], [305, 306, 307], list(range(1, 600)), [450, 480]])
def test_stretches_give_what_the_whole_gives(cuts: list[int]) -> None:
    z = np.random.default_rng(4).normal(size=600)
    z[300:350] += 4.0
    z[450] = 1e9
    state, found = whole(z)
    state_cut, found_cut = whole(z, cuts)
    assert [(i.start, i.stop) for i in found_cut] == [(i.start, i.stop) for i in found]
    np.testing.assert_allclose([i.score for i in found_cut], [i.score for i in found], rtol=1e-6)
    assert state_cut["T"].keys() == state["T"].keys()


def test_missing_samples_are_passed_over() -> None:
    z = np.random.default_rng(5).normal(size=400)
    z[100:200] = np.nan
    assert whole(z)[1] == []
    assert whole(np.full(50, np.nan))[1] == []


def test_it_closes_after_enough_quiet_samples() -> None:
    z = np.zeros(200)
    z[50] = 100.0
    _, found = whole(z)
    assert len(found) == 1
    last_loud = 50 + MEAN_WINDOW - 1  # the bounded spike leaves the window of the mean after that
    assert found[0].stop == last_loud * 10
    _, open_still = whole(z[: last_loud + HOLD])
    assert open_still[0].stop is None
