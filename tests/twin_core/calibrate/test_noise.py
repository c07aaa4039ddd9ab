"""Noise told from samples: the number that went in comes out, whatever the signal under it."""

import numpy as np
import pytest

from tests.helpers import record_of
from twin_core.calibrate.noise import DYNAMICS, FALLBACK_STD_K, difference_noise_K, noise_beside_K, sensor_noise_K
from twin_core.network.spec_io import load_spec
from twin_core.quality.quantisation import quantum

RNG_SIZE = 4000


def noise(std_K: float, seed: int = 0, n: int = RNG_SIZE) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, std_K, n)


@pytest.mark.statistical
@pytest.mark.parametrize("std_K", [0.01, 0.2])
def test_second_differences_see_the_noise_through_a_slow_signal(std_K: float) -> None:
    slow = 290.0 + 10.0 * np.sin(np.arange(RNG_SIZE) / 300.0)
    # A median of 4000 absolute values is within 4 % of its expectation in all but one case in a hundred.
    assert difference_noise_K(np.arange(RNG_SIZE), slow + noise(std_K)) == pytest.approx(std_K, rel=0.05)


def test_steps_and_gaps_do_not_count_as_noise() -> None:
    stepped = 290.0 + 5.0 * (np.arange(RNG_SIZE) // 100 % 2) + noise(0.1)
    stepped[np.random.default_rng(1).random(RNG_SIZE) < 0.2] = np.nan
    assert difference_noise_K(60.0 * np.arange(RNG_SIZE), stepped) == pytest.approx(0.1, rel=0.1)


@pytest.mark.statistical
@pytest.mark.parametrize("law", ["jitter", "bursts", "exponential"])
def test_uneven_sampling_of_a_steep_signal_does_not_count_as_noise(law: str) -> None:
    """An orbit of 40 K from peak to peak, read every minute on average: a slope of 20 times the noise from one to the next."""
    rng = np.random.default_rng(2)
    steps_s = {
        "jitter": rng.uniform(18.0, 102.0, RNG_SIZE),
        "bursts": np.where(np.arange(RNG_SIZE) % 5, 30.0, 180.0),
        "exponential": 1.0 + rng.exponential(59.0, RNG_SIZE),
    }[law]
    time_s = np.cumsum(steps_s)
    steep = 280.0 + 20.0 * np.sin(2.0 * np.pi * time_s / 5700.0)
    assert difference_noise_K(time_s, steep + noise(0.036)) == pytest.approx(0.036, rel=0.08)


@pytest.mark.parametrize("column", [np.zeros(5), np.full(100, np.nan), np.array([])])
def test_too_few_samples_tell_nothing(column: np.ndarray) -> None:
    assert np.isnan(difference_noise_K(np.arange(column.size) ** 1.5, column))


def test_a_quantised_series_shows_its_step() -> None:
    signal = 290.0 + 3.0 * np.sin(np.arange(800) / 60.0)
    assert quantum(np.round(signal / 0.25) * 0.25) == pytest.approx(0.25)
    assert quantum(signal + noise(0.1, n=800)) == 0.0
    assert quantum(np.full(50, 290.0)) == 0.0


SPEC = load_spec(
    {
        "twin": "t",
        "channels": {
            "A": {"kind": "temperature", "unit": "K"},
            "B": {"kind": "temperature", "unit": "degC", "noise_std": 0.05},
            "C": {"kind": "temperature", "unit": "K", "noise_std": 0.01},
        },
        "nodes": [{"id": "n", "sensor": ["A", "B", "C"]}],
    }
)


def test_quantisation_adds_its_variance_to_a_declared_noise() -> None:
    signal = 290.0 + 3.0 * np.sin(np.arange(800) / 60.0)
    coarse = np.round(signal / 0.5) * 0.5
    record = record_of(np.arange(800.0), A=signal + noise(0.3, n=800), B=signal + noise(0.3, 1, 800), C=coarse)
    found = sensor_noise_K(SPEC, [record])
    assert found[0] == pytest.approx(0.3, rel=0.1)
    assert found[1] == 0.05
    assert found[2] == pytest.approx(np.sqrt(0.01**2 + 0.5**2 / 12.0))


@pytest.mark.statistical
@pytest.mark.parametrize("steps", [0.3, 1.0, 2.0, 3.0, 4.0])
def test_noise_below_and_above_the_step_of_a_sensor_is_told(steps: float) -> None:
    """The variance of the noise and of an even error over one step add up (Bennett 1948), however the two compare."""
    swing = 290.0 + 1.2 * np.sin(np.arange(RNG_SIZE) / 9.0) + noise(0.1)
    quantised = steps * 0.1 * np.round(swing / (steps * 0.1))
    assert readings(quantised) == pytest.approx(0.1 * np.sqrt(1.0 + steps**2 / 12.0), rel=0.1)


def test_a_sensor_that_tells_nothing_gets_a_usual_noise() -> None:
    found = sensor_noise_K(SPEC, [record_of(np.arange(4.0), A=290.0, B=290.0)])
    np.testing.assert_array_equal(found, [FALLBACK_STD_K, 0.05, 0.01])


def readings(column: np.ndarray) -> float:
    """Return the noise of a sensor for which none is declared."""
    filler = np.full(column.size, 280.0)
    return float(sensor_noise_K(SPEC, [record_of(60.0 * np.arange(column.size), A=column, B=filler, C=filler)])[0])


@pytest.mark.parametrize("period", [2, 3, 5])
def test_repeats_between_the_samples_of_a_slow_sensor_are_no_quiet_readings(period: int) -> None:
    own = 290.0 + 3.0 * np.sin(np.arange(2000) / 300.0) + noise(0.1, n=2000)
    held = np.repeat(own, period)
    alone = np.where(np.arange(held.size) % period == 0, held, np.nan)
    assert readings(alone) == pytest.approx(0.1, rel=0.1)
    if period > 3:  # of fewer repeats second differences see some, and the screening leaves none
        assert readings(held) == pytest.approx(0.1, rel=0.1)


def test_a_sensor_that_hardly_moves_shows_its_resolution_at_most() -> None:
    """A whole kelvin from code to code, crossed three times: readings are good to 1 / sqrt 12 of it, not to nothing."""
    assert readings(np.repeat([333.0, 334.0, 335.0, 336.0], 12)) == pytest.approx(1.0 / np.sqrt(12.0))
    assert readings(np.full(50, 290.0)) == FALLBACK_STD_K


def test_of_a_short_quantised_record_the_step_tells_and_no_rounding() -> None:
    """Seven steps of 0.32 K among thirteen repeats: the median of their differences was 3e-14 K, taken for noise."""
    rises = [0.0] * 9 + [0.32, 0.0, 0.0, 0.32, 0.32, 0.0, 0.0, 0.32, 0.0, 0.33, 0.32, 0.0]
    column = np.round(20.9 + np.cumsum(rises), 2) + 273.15
    assert quantum(column) == pytest.approx(0.32, rel=0.01)
    assert readings(column) == pytest.approx(0.32 / np.sqrt(12.0), rel=0.3)


def test_what_a_model_leaves_of_resting_codes_is_no_noise() -> None:
    """A sensor that counts in 0.32 K and rests is not read to the microkelvins by which a model misses it."""
    column = np.where(np.arange(21) < 15, 293.15, 293.47)
    spec = load_spec(
        {"twin": "t", "channels": {"A": {"kind": "temperature", "unit": "K"}}, "nodes": [{"id": "n", "sensor": "A"}]}
    )
    record = record_of(np.arange(21.0), A=column)
    residual_K = 1e-6 * np.sin(np.arange(21.0))[:, None]
    found = noise_beside_K(spec, [record], sensor_noise_K(spec, [record]), [residual_K])
    np.testing.assert_allclose(found, 0.32 / np.sqrt(12.0))


@pytest.mark.parametrize(
    ("period", "declared", "told_K"),
    [(9.0, None, 0.1), (400.0, None, None), (9.0, 0.5, None)],
    ids=["turns between samples", "slow", "declared"],
)
def test_what_a_model_follows_is_no_noise(period: float, declared: float | None, told_K: float | None) -> None:
    """Samples 30 s apart of a board that warms in two minutes told seven times its noise, and any misfit stayed below that."""
    rng = np.random.default_rng(5)
    spec = load_spec(
        {
            "twin": "board",
            "channels": {"T": {"kind": "temperature", "unit": "K"} | ({"noise_std": declared} if declared else {})},
            "nodes": [{"id": "a", "sensor": "T", "capacity_J_per_K": {"guess": 5.0}}],
        }
    )
    at = np.arange(600.0)
    truth_K, noise_K = 300.0 + 5.0 * np.sin(2.0 * np.pi * at / period), rng.normal(0.0, 0.1, at.size)
    record = record_of(30.0 * at, T=truth_K + noise_K)
    before_K = sensor_noise_K(spec, [record])
    after_K = noise_beside_K(spec, [record], before_K, [noise_K[:, None]])
    if told_K is None:
        np.testing.assert_array_equal(after_K, before_K)
    else:
        assert before_K[0] > 5.0 * DYNAMICS * told_K
        np.testing.assert_allclose(after_K, told_K, rtol=0.15)
        # Not what a poor model follows no better than the differences did.
        np.testing.assert_array_equal(noise_beside_K(spec, [record], before_K, [record.values["T"][:, None]]), before_K)
