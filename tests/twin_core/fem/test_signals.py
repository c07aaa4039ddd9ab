"""Signals: formulas, statistics, and the same value at the same time however it is asked."""

import numpy as np
import pytest
from pydantic import TypeAdapter

from twin_core.fem.signals import AnySignal, Path, Signal, Span

ADAPTER: TypeAdapter[Signal] = TypeAdapter(AnySignal)


def realised(seed: int = 1, stop_s: float = 20_000.0, **fields: object) -> Path:
    """Return a signal as a function of time."""
    signal = ADAPTER.validate_python(fields)
    return signal.realise(Span(0.0, stop_s, np.random.default_rng(seed), 1_767_225_600_000_000_000))


ALL = [
    {"signal": "constant", "value": 4.0},
    {"signal": "sine", "mean": 2.0, "amplitude": 3.0, "period_s": 700.0, "phase_deg": 30.0},
    {"signal": "sun", "peak": 100.0, "period_s": 6000.0, "eclipse_deg": 120.0},
    {"signal": "telegraph", "levels": [0, 10, 30], "dwell_s": 500.0},
    {"signal": "slew", "between": [0, 90], "dwell_s": 600.0, "rate_per_s": 0.1},
    {"signal": "gaussian_process", "mean": 50.0, "std": 10.0, "correlation_length_s": 700.0, "minimum": 0.0},
    {"signal": "table", "time_s": [0, 100, 300], "values": [1, 5, 2]},
    {
        "signal": "orbit_face",
        "elements": {"epoch": "2026-01-01T00:00:00Z", "semi_major_axis_m": 7e6, "inclination_deg": 60},
        "normal": [0, 0, 1],
        "area_m2": 0.5,
        "absorptance": 0.3,
        "emissivity": 0.8,
    },
]


@pytest.mark.parametrize("fields", ALL, ids=lambda fields: str(fields["signal"]))
def test_a_signal_is_a_function_of_time(fields: dict[str, object]) -> None:
    """Asked for all times, one by one or in a table, it answers the same; the same seed repeats it."""
    path, again = realised(**fields), realised(**fields)
    time_s = np.linspace(0.0, 19_000.0, 60)
    values = path(time_s)
    assert values.shape == (60,) and np.isfinite(values).all()
    np.testing.assert_allclose(np.concatenate([path(t[None]) for t in time_s]), values)
    np.testing.assert_allclose(path(time_s.reshape(20, 3)), values.reshape(20, 3))
    np.testing.assert_array_equal(again(time_s), values)


def test_sun_is_half_a_cosine_outside_the_shadow() -> None:
    """Peak at noon, nothing on the far side, nothing in the shadow although the face looks at the Sun."""
    path = realised(signal="sun", peak=100.0, period_s=3600.0, phase_deg=90.0, eclipse_deg=120.0)
    at_deg = path(np.array([90.0, 150.0 - 0.1, 119.0, 121.0, 180.0, 270.0, 30.0]) * 10.0)
    cosine = 100.0 * np.cos(np.radians([29.0, 60.0]))
    np.testing.assert_allclose(at_deg, [100.0, 0.0, cosine[0], 0.0, 0.0, 0.0, cosine[1]], atol=1e-9)


def test_table_is_joined_or_held() -> None:
    """Straight lines between the points, or the last value; constant beyond the ends."""
    times = np.array([-10.0, 0.0, 50.0, 100.0, 200.0, 900.0])
    fields = {"signal": "table", "time_s": [0, 100, 300], "values": [1, 5, 2]}
    np.testing.assert_allclose(realised(**fields)(times), [1.0, 1.0, 3.0, 5.0, 3.5, 2.0])
    np.testing.assert_allclose(realised(held=True, **fields)(times), [1.0, 1.0, 1.0, 5.0, 5.0, 2.0])


@pytest.mark.statistical
def test_gaussian_process_has_its_mean_spread_and_correlation() -> None:
    """Over 4000 lengths: mean, standard deviation and correlation at half, one and two lengths."""
    length_s = 700.0
    path = realised(
        stop_s=4000.0 * length_s, signal="gaussian_process", mean=50.0, std=10.0, correlation_length_s=length_s
    )
    time_s = np.arange(0.0, 3998.0 * length_s, length_s / 2.0)
    x = (path(time_s) - 50.0) / 10.0
    # About 4000 / sqrt(pi) independent values: standard errors near 0.02.
    assert abs(x.mean()) < 0.08
    assert x.std() == pytest.approx(1.0, abs=0.06)
    for lag in (1, 2, 4):
        assert np.mean(x[lag:] * x[:-lag]) == pytest.approx(np.exp(-((lag / 2.0) ** 2) / 2.0), abs=0.06)


@pytest.mark.statistical
def test_telegraph_rests_exponentially_and_visits_all_levels() -> None:
    """Mean rest as declared to 5 %, levels equally often, never a switch to the same level."""
    path = realised(stop_s=2e6, signal="telegraph", levels=[0, 10, 30], dwell_s=500.0)
    values = path(np.arange(0.0, 2e6, 5.0))
    switches = np.count_nonzero(np.diff(values))
    # 4000 switches are uncertain by 1.6 %; 1 % of rests are shorter than a sample and go unseen.
    assert switches == pytest.approx(4000, rel=0.06)
    for level in (0, 10, 30):
        assert np.mean(values == level) == pytest.approx(1 / 3, abs=0.05)
