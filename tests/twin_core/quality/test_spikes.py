"""Spikes: planted ones are found, and whatever a heat balance can do is kept."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from twin_core.quality.spikes import spikes

STEFAN_BOLTZMANN = 5.670374419e-8
ORBIT_S = 5700.0


def panel_K(areal_capacity: float, spin_s: float | None, n_orbits: int, tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a panel's temperature in a low orbit every 2 s, by the classical Runge-Kutta method.

    It is lit by the Sun as its turning normal allows outside the shadow, by albedo, by the Earth's infrared, and radiates
    from both sides: C T' = a S cos+ + e q - 2 e sigma T^4.
    """
    step_s = 2.0
    time_s = np.arange(0.0, n_orbits * ORBIT_S, step_s)

    def heat(at_s: np.ndarray) -> np.ndarray:
        phase = 2.0 * np.pi * at_s / ORBIT_S
        lit = np.abs((at_s / ORBIT_S) % 1.0 - 0.5) > 0.18
        turn = 2.0 * np.pi * at_s / (spin_s or ORBIT_S) + tilt
        sun = 0.85 * 1361.0 * np.maximum(np.cos(turn), 0.0) * lit
        albedo = 0.85 * 0.3 * 1361.0 * 0.6 * np.maximum(np.cos(phase), 0.0) * np.maximum(-np.cos(turn - phase), 0.0)
        return np.asarray(sun + albedo + 0.8 * 110.0)

    q0, q1, q2 = heat(time_s), heat(time_s + step_s / 2.0), heat(time_s + step_s)
    temperature, out = 260.0, np.empty(time_s.size)

    def rate(q: float, t: float) -> float:
        return (q - 1.6 * STEFAN_BOLTZMANN * t**4) / areal_capacity

    for i in range(time_s.size):
        out[i] = temperature
        k1 = rate(q0[i], temperature)
        k2 = rate(q1[i], temperature + 0.5 * step_s * k1)
        k3 = rate(q1[i], temperature + 0.5 * step_s * k2)
        k4 = rate(q2[i], temperature + step_s * k3)
        temperature += step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return time_s, out


@settings(max_examples=60, deadline=None)
@given(
    capacity=st.floats(2.5, 5.0).map(lambda decade: 10.0**decade),
    spin_s=st.one_of(st.none(), st.floats(60.0, 3000.0)),
    n_orbits=st.integers(1, 5),
    tilt=st.floats(0.0, 6.28),
    sample_s=st.sampled_from([10, 20, 30, 60, 120, 180, 300]),
    noise_K=st.sampled_from([0.0, 0.01, 0.05, 0.2]),
    step_K=st.sampled_from([0.0, 0.1, 0.5]),
    seed=st.integers(0, 2**32 - 1),
)
def test_no_orbit_loses_a_reading(
    capacity: float,
    spin_s: float | None,
    n_orbits: int,
    tilt: float,
    sample_s: int,
    noise_K: float,
    step_K: float,
    seed: int,
) -> None:
    """Foils of 300 J/(m2 K) to boxes of 100 kJ/(m2 K), held still or spinning, however sampled, noisy and rounded."""
    time_s, clean_K = panel_K(capacity, spin_s, n_orbits, tilt)
    every = sample_s // 2
    column = clean_K[::every] + np.random.default_rng(seed).normal(0.0, noise_K, clean_K[::every].size)
    if step_K:
        column = np.round(column / step_K) * step_K
    assert not spikes(time_s[::every], column).any()


def test_the_peak_of_every_orbit_of_a_light_panel_stays() -> None:
    """Thirty orbits at 60 s: the panel leads into the shadow at its hottest, one reading sharp."""
    time_s, clean_K = panel_K(3000.0, None, 30, 0.4)
    column = clean_K[::30] + np.random.default_rng(1).normal(0.0, 0.05, clean_K[::30].size)
    assert not spikes(time_s[::30], column).any()


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    height_K=st.floats(25.0, 300.0),
    sign=st.sampled_from([-1.0, 1.0]),
    length=st.integers(1, 3),
    sample_s=st.sampled_from([10, 30, 60]),
)
@example(
    seed=0, height_K=25.0, sign=-1.0, length=3, sample_s=10
)  # one spike that noise hides made all the others healthy
def test_planted_spikes_are_found_and_nothing_else(
    seed: int, height_K: float, sign: float, length: int, sample_s: int
) -> None:
    rng = np.random.default_rng(seed)
    time_s, clean_K = panel_K(20_000.0, None, 4, 1.0)
    time_s, column = time_s[:: sample_s // 2], clean_K[:: sample_s // 2] + 0.0
    column += rng.normal(0.0, 0.05, column.size)
    planted = np.zeros(column.size, dtype=bool)
    for place in np.linspace(20, column.size - 20, 5).astype(int) + rng.integers(-8, 8, 5):
        planted[place : place + length] = True
    column[planted] += sign * height_K
    np.testing.assert_array_equal(spikes(time_s, column), planted)


def test_healthy_readings_are_kept() -> None:
    """Noise, switched heaters, a thermostat's saw, a quantised rest, a step that stays, a gap with a jump."""
    rng = np.random.default_rng(0)
    saw = 290.0 + 8.0 * np.abs((np.arange(400) / 7.0) % 2.0 - 1.0)
    rest = np.round(rng.normal(290.0, 0.03, 400), 1)
    step = np.where(np.arange(400) < 200, 280.0, 320.0) + rng.normal(0.0, 0.05, 400)
    gap = np.where((np.arange(400) > 100) & (np.arange(400) < 150), np.nan, step)
    for column in (saw, rest, step, gap, rng.normal(290.0, 0.1, 400)):
        assert not spikes(np.arange(400.0), column).any()


@pytest.mark.parametrize("lasting", [2, 3, 4, 60])
def test_a_record_that_begins_or_ends_in_a_fast_transient_is_kept(lasting: int) -> None:
    """A closed form: 320 K, then an exponential decay of which a few readings are seen; and the same backwards in time."""
    since = np.maximum(np.arange(60 + lasting) - 59.0, 0.0)
    column = 290.0 + 30.0 * np.exp(-since / 10.0) + np.random.default_rng(0).normal(0.0, 0.01, since.size)
    for healthy in (column, column[::-1]):
        assert not spikes(np.arange(float(since.size)), healthy).any()


@pytest.mark.statistical
def test_noise_alone_is_lost_as_seldom_as_stated() -> None:
    """1000 records of white noise at a tolerated rate of 1e-3 each: more than six losses have a probability of 1e-4."""
    lost = sum(
        bool(spikes(np.arange(300.0), np.random.default_rng([7, seed]).normal(290.0, 0.1, 300)).any())
        for seed in range(1000)
    )
    assert lost <= 6
