"""Periods: found where they are, to a fraction of a sample, and seldom where they are not."""

import numpy as np
import pytest

from twin_core.forecast.period import SIGNIFICANCE, find_period

STEP_S = 60.0


def square(time_s: np.ndarray, period_s: float, duty: float) -> np.ndarray:
    return np.where(time_s % period_s < duty * period_s, 12.0, 3.0)


def test_the_period_of_a_square_wave_is_found() -> None:
    """With a tenth of noise, whatever its unit: to one sample, which is where its edges are known to.

    The rule is a test of significance: of so few cycles it misses some, one in a thousand of these draws.
    """
    rng = np.random.default_rng(0)
    n_draws, n_missed = 120, 0
    for _ in range(n_draws):
        period_s, duty, n_cycles = rng.uniform(1200.0, 8000.0), rng.uniform(0.2, 0.8), rng.uniform(4.0, 15.0)
        time_s = np.arange(0.0, n_cycles * period_s, STEP_S)
        column = square(time_s, period_s, duty) + rng.normal(0.0, 0.9, time_s.size)
        found = find_period(time_s, 10.0 ** rng.uniform(-3.0, 3.0) * column, held=True)
        if found is None:
            n_missed += 1
            continue
        assert found.p_value <= SIGNIFICANCE
        n_periods = max(1, round(found.period_s / period_s))  # by noise a multiple may look better: it repeats as well
        assert abs(found.period_s - n_periods * period_s) < STEP_S
    assert n_missed <= 1


def test_a_period_is_known_better_than_the_sampling() -> None:
    """Fourteen cycles of a smooth wave: a fiftieth of a sample."""
    time_s = np.arange(0.0, 14 * 5677.3, STEP_S)
    found = find_period(time_s, 250.0 + np.sin(2.0 * np.pi * time_s / 5677.3), held=False)
    assert found is not None
    assert abs(found.period_s - 5677.3) < STEP_S / 50.0


def test_irregular_samples_of_a_drifting_wave() -> None:
    rng = np.random.default_rng(3)
    time_s = np.sort(rng.uniform(0.0, 12 * 5400.0, 900))
    column = np.sin(2.0 * np.pi * time_s / 5400.0) + 3e-6 * time_s
    found = find_period(time_s, column, held=False)
    assert found is not None
    assert abs(found.period_s - 5400.0) < 30.0


@pytest.mark.parametrize("kind", ["white", "walk", "red", "telegraph", "ramp", "step"])
def test_what_has_no_period_seldom_gets_one(kind: str) -> None:
    """One in twenty by the test's own statement: more than nine of sixty would come up once in 500 trials."""
    n, n_found = 800, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        shocks = rng.normal(size=n)
        column = {
            "white": lambda s=shocks: s,
            "walk": lambda s=shocks: np.cumsum(s),
            "red": lambda s=shocks: np.convolve(s, 0.97 ** np.arange(200))[:n],
            "telegraph": lambda r=rng: np.repeat(r.integers(0, 3, n), r.poisson(40, n) + 1)[:n].astype(float),
            "ramp": lambda s=shocks: np.arange(n) + s,
            "step": lambda r=rng: (np.arange(n) > r.integers(10, n - 10)).astype(float),
        }[kind]()
        n_found += find_period(STEP_S * np.arange(n), column, held=True) is not None
    assert n_found <= 9


@pytest.mark.parametrize("n", [1, 2, 5, 6, 7, 12])
def test_little_or_constant_telemetry_has_no_period(n: int) -> None:
    assert find_period(STEP_S * np.arange(n), np.full(n, 4.0), held=True) is None
    alternating = np.arange(n, dtype=float) % 2
    assert find_period(STEP_S * np.arange(n), alternating, held=True) is None  # two samples show no cycle
