"""What a heat comes back with: closed forms whose answer is known."""

import numpy as np
import pytest

from twin_core.missing_heat.drivers import followed, phases, repeats_with

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


DRIFT_K = TIMES / TIMES[-1]
LAWS = {
    "linear": lambda t: 0.3 * (t - 280.0),
    "radiation": lambda t: 1e-8 * t**4,
    "exponential": lambda t: np.exp((290.0 - t) / 5.0),
}


@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
@pytest.mark.parametrize("drift_K", [5.0, 10.0, 20.0])
def test_a_function_of_the_driver_is_predicted_although_the_record_drifts(law, drift_K: float) -> None:  # type: ignore[no-untyped-def]
    drifting = TEMPERATURE + drift_K * DRIFT_K
    assert repeats_with(law(drifting), drifting) > 0.9


def test_a_straight_law_is_predicted_where_the_halves_share_no_temperature() -> None:
    drifting = TEMPERATURE + 100.0 * DRIFT_K
    assert repeats_with(0.3 * (drifting - 280.0), drifting) > 0.99


def test_walks_seldom_repeat_with_one_another_or_with_a_drift() -> None:
    """Two hundred pairs of walks, independent by construction: no more than one in twenty may seem to repeat."""
    drifting = TEMPERATURE + 20.0 * DRIFT_K
    shares = []
    for seed in range(100):
        walk, other = np.cumsum(np.random.default_rng(seed).normal(size=(2, TIMES.size)), axis=1)
        shares += [repeats_with(walk, other), repeats_with(walk, drifting)]
    assert np.mean(np.array(shares) > 0.5) < 0.05


def test_a_coupling_repeats_with_the_difference_of_two_temperatures() -> None:
    other = 285.0 + 4.0 * np.sin(2 * np.pi * TIMES / 9100.0) + 15.0 * DRIFT_K
    heat = 0.8 * (other - TEMPERATURE)
    shares = followed(
        TIMES, heat, {"temperature of px": TEMPERATURE}, own_K=TEMPERATURE, others_K={"tank": other, "mx": WANDERING}
    )
    name, share = next(iter(shares.items()))
    assert name == "temperature of tank over its own" and share > 0.99
