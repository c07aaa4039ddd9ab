"""Down-sampling keeps every extreme and invents nothing."""

import numpy as np
import pytest

from service.archive.downsample import extremes


@pytest.mark.parametrize("n_channels", [1, 3, 12])
@pytest.mark.parametrize("max_points", [2, 10, 100, 1000])
def test_never_more_than_asked_for_and_both_ends_stay(n_channels: int, max_points: int) -> None:
    values = np.random.default_rng(0).normal(size=(n_channels, 5003))
    kept = extremes(values, max_points)
    assert kept.size <= max_points
    assert (np.diff(kept) > 0).all()
    assert (kept[0], kept[-1]) == (0, 5002)


def test_a_spike_in_any_channel_stays() -> None:
    values = np.zeros((3, 100_000))
    values[2, 77_777] = 5.0
    values[0, 33_333] = -5.0
    assert {77_777, 33_333} <= set(extremes(values, 200).tolist())


def test_missing_samples_do_not_count() -> None:
    values = np.full((1, 1000), np.nan)
    values[0, 500] = 1.0
    assert 500 in extremes(values, 50)


def test_few_samples_stay_as_they_are() -> None:
    assert extremes(np.zeros((2, 7)), 7).tolist() == list(range(7))
