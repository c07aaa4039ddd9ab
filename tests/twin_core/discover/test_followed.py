"""What a heat comes back with: closed forms whose answer is known."""

import numpy as np
import pytest

from twin_core.discover.followed import followed, phases, repeats_with

TIMES = 60.0 * np.arange(3000)
RNG = np.random.default_rng(0)
WANDERING = np.cumsum(RNG.normal(size=TIMES.size))
TEMPERATURE = 290.0 + 5.0 * np.sin(2 * np.pi * TIMES / 5400.0) + 2.0 * np.sin(2 * np.pi * TIMES / 31000.0)


def test_a_function_of_the_driver_is_predicted() -> None:
    heat = np.exp(-0.5 * ((TEMPERATURE - 288.0) / 3.0) ** 2)
    assert repeats_with(heat, TEMPERATURE) > 0.95


def test_noise_takes_its_own_share() -> None:
    heat = TEMPERATURE - TEMPERATURE.mean()
    noisy = heat + RNG.normal(0.0, heat.std(), heat.size)  # half of the variance is noise
    assert repeats_with(noisy, TEMPERATURE) == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("driver", [WANDERING, np.full(TIMES.size, 3.0), RNG.normal(size=TIMES.size)])
def test_what_only_happened_to_go_along_predicts_little(driver: np.ndarray) -> None:
    other = np.cumsum(np.random.default_rng(7).normal(size=TIMES.size))
    assert repeats_with(other, driver) < 0.3


def test_the_orbit_stands_out() -> None:
    heat = np.where(TIMES % 5400.0 < 2000.0, 4.0, 0.0)
    shares = followed(TIMES, heat, {"wandering": WANDERING})
    name, share = next(iter(shares.items()))
    period = float(name.removeprefix("phase of ").removesuffix(" s"))
    assert share > 0.9 and period == pytest.approx(5400.0, rel=0.01)
    assert all(5 * TIMES[1] < p < np.ptp(TIMES) / 2.9 for p in phases(TIMES, heat))
