"""Runs: several at once, the record an operator sees, bad combinations."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from twin_core._typing import no_progress
from twin_core.errors import Cancelled, ModelError, SpecError
from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import simulate, simulate_many

Maker = Callable[..., dict[str, Any]]


def test_side_by_side_equals_one_by_one(two_plates: Maker) -> None:
    """Three scenarios with different forcings and hidden effects, at once and each on its own."""
    heat = {"effect": "constant_heat_load", "node": "c", "Q_W": 8.0}
    forcings = two_plates()["forcings"]
    forcings["Q"]["signal"] = {"signal": "telegraph", "levels": [5, 60], "dwell_s": 900}
    bodies = [two_plates(), two_plates(hidden=[heat], scenario="other"), two_plates(forcings=forcings, seed=4)]
    scenarios = [load_scenario(body) for body in bodies]
    for together, scenario in zip(simulate_many(scenarios), scenarios, strict=True):
        alone = simulate(scenario)
        for region in "abc":
            np.testing.assert_allclose(together.truth.region_K[region], alone.truth.region_K[region], atol=1e-7)
        np.testing.assert_array_equal(together.record.channel("Q"), alone.record.channel("Q"))


def test_what_cannot_share_a_run_is_refused(two_plates: Maker) -> None:
    """Different contacts need different matrices: the message names the field."""
    other = two_plates(joints=[{"between": ["a", "b"], "conductance_W_per_m2_K": 51.0}], scenario="other")
    with pytest.raises(ModelError, match=r"'other' cannot share a run with 'two-plates': joints differ"):
        simulate_many([load_scenario(two_plates()), load_scenario(other)])
    later = two_plates()
    later["time"] = later["time"] | {"start": "2026-05-01T00:00:00Z"}
    with pytest.raises(ModelError, match="steps differ"):
        simulate_many([load_scenario(two_plates()), load_scenario(later)])
    with pytest.raises(ModelError, match="no scenario"):
        simulate_many([])


def test_the_record_carries_what_was_asked_for(two_plates: Maker) -> None:
    """Noise, quantum, jitter, gaps and date reach the record; inputs are exact; hidden sensors of truth are not."""
    time = {
        "duration_s": 6000,
        "step_s": 20,
        "sample_s": 20,
        "start": "2026-05-01T00:00:00Z",
        "jitter_s": 4,
        "missing_fraction": 0.2,
        "gaps": [{"start_s": 1000, "stop_s": 1500}, {"start_s": 3000, "stop_s": 3200, "channel": "T_a"}],
    }
    sensors = [
        {"channel": "T_a", "region": "a", "noise_std_K": 0.2},
        {"channel": "T_b", "region": "b", "quantum_K": 0.25},
    ]
    result = simulate(load_scenario(two_plates(time=time, sensors=sensors)))
    record, time_s = result.record, result.record.time_s
    assert record.present(0.0) == "2026-05-01T00:00:00Z"
    assert set(record.values) == {"T_a", "T_b", "Q", "mode"}
    assert 12.0 <= np.diff(time_s).min() < 19.0 < 21.0 < np.diff(time_s).max() <= 28.0
    gap = (time_s >= 1000) & (time_s < 1500)
    assert all(np.isnan(column[gap]).all() for column in record.values.values())
    assert np.isnan(record.channel("T_a")[(time_s >= 3000) & (time_s < 3200)]).all()
    assert not np.isnan(record.channel("Q")[~gap]).any()
    assert np.isnan(record.channel("T_b")[~gap]).mean() == pytest.approx(0.2, abs=0.1)
    reading = record.channel("T_b")
    np.testing.assert_allclose(np.round(reading * 4.0), reading * 4.0)
    true_K = np.interp(time_s, result.truth.time_s, result.truth.temperature_K["T_b"])
    assert np.nanmax(np.abs(reading - true_K)) <= 0.125 + 1e-9


def test_held_inputs_deliver_exactly_what_the_samples_say(two_plates: Maker) -> None:
    """Energy of an isolated plate: capacity times its rise equals the samples' heat, each held until the next."""
    forcings = two_plates()["forcings"]
    forcings["Q"]["signal"] = {"signal": "telegraph", "levels": [0, 40, 70], "dwell_s": 333}
    time = {"duration_s": 6000, "step_s": 20, "sample_s": 60}
    loads = [{"forcing": "Q", "place": "c"}]
    result = simulate(load_scenario(two_plates(forcings=forcings, loads=loads, time=time)))
    heat_J = np.cumsum(result.record.channel("Q")[:-1] * 60.0)
    rise_K = result.record.channel("T_c")[1:] - 290.0
    np.testing.assert_allclose(rise_K, heat_J / 2e4, atol=1e-7)


def test_the_edge_of_a_shadow_inside_a_step_delivers_its_due(two_plates: Maker) -> None:
    """Sun with eclipse on an isolated plate, joined linearly: capacity times rise equals the integral of the sun."""
    forcings = two_plates()["forcings"]
    sun = {"signal": "sun", "peak": 80.0, "period_s": 5700.0, "phase_deg": 60.0, "eclipse_deg": 131.0}
    forcings["Q"] = {"kind": "power", "unit": "W", "interpolation": "linear", "signal": sun}
    time = {"duration_s": 6000, "step_s": 100, "sample_s": 100}
    loads = [{"forcing": "Q", "place": "c"}]
    record = simulate(load_scenario(two_plates(forcings=forcings, loads=loads, time=time))).record
    angle_deg = 360.0 * (np.arange(600_000) + 0.5) * 0.01 / 5700.0
    lit = np.abs(angle_deg - 180.0) >= 65.5
    sun_W = np.where(lit, 80.0 * np.maximum(np.cos(np.radians(angle_deg - 60.0)), 0.0), 0.0)
    # A step is seen in sixteen parts: an edge of 32 W is misplaced by 3 s at most, 5 mK.
    assert record.channel("T_c")[-1] - 290.0 == pytest.approx(sun_W.sum() * 0.01 / 2e4, abs=5e-3)


def test_settling_happens_before_the_record(two_plates: Maker) -> None:
    """With a long settling time the record starts at rest."""
    time = {"duration_s": 600, "step_s": 60, "sample_s": 60, "settle_s": 60_000}
    record = simulate(load_scenario(two_plates(time=time))).record
    assert record.time_s[0] == 0.0
    assert np.ptp(record.channel("T_a")) < 0.01 < abs(record.channel("T_a")[0] - 290.0)


def test_progress_rises_to_one_and_may_cancel(two_plates: Maker) -> None:
    """Fractions never fall; an exception from the callback ends the run."""
    seen: list[float] = []
    simulate(load_scenario(two_plates()), lambda fraction, message: seen.append(fraction))
    assert seen == sorted(seen) and seen[-1] == 1.0

    def cancel(fraction: float, message: str) -> None:
        no_progress(fraction, message)
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        simulate(load_scenario(two_plates()), cancel)


def test_a_channel_without_a_sample_is_refused(two_plates: Maker) -> None:
    """A gap that swallows a channel names it."""
    time = {"duration_s": 600, "step_s": 20, "sample_s": 20, "gaps": [{"start_s": -1, "stop_s": 9999, "channel": "Q"}]}
    with pytest.raises(SpecError, match="channel 'Q' has no sample left"):
        simulate(load_scenario(two_plates(time=time)))
