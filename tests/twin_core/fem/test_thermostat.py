"""Declared thermostats: their power is telemetry, and telemetry is what they delivered."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from twin_core.errors import SpecError
from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import simulate, simulate_many

Maker = Callable[..., dict[str, Any]]
HEATER = {"channel": "H", "region": "a", "Q_W": 60.0, "T_on_K": 289.6, "T_off_K": 290.2}


@pytest.mark.parametrize("step_s", [10, 20])
def test_the_record_replayed_as_an_input_gives_the_same_temperatures(two_plates: Maker, step_s: int) -> None:
    """The heater's channel, declared as an ordinary load that holds between samples, does what the heater did."""
    time = {"duration_s": 6000, "step_s": step_s, "sample_s": 20}
    quiet = two_plates()["forcings"]
    quiet["Q"]["signal"]["value"] = 0.0
    switching = simulate(load_scenario(two_plates(time=time, forcings=quiet, thermostats=[HEATER])))
    power_W, time_s = switching.record.values["H"], switching.record.time_s
    assert set(power_W) == {0.0, 60.0}
    assert np.count_nonzero(np.diff(power_W)) >= 3
    held = {"signal": "table", "time_s": time_s.tolist(), "values": power_W.tolist(), "held": True}
    forcings = quiet | {"H": {"kind": "power", "unit": "W", "signal": held}}
    loads = [*two_plates()["loads"], {"forcing": "H", "place": "a"}]
    replayed = simulate(load_scenario(two_plates(time=time, forcings=forcings, loads=loads)))
    for region in "abc":
        np.testing.assert_allclose(replayed.truth.region_K[region], switching.truth.region_K[region], atol=1e-6)
    assert max(np.abs(heat).max() for heat in switching.truth.hidden_heat_W.values()) == 0.0
    assert switching.truth.imbalance.max() < 1e-9


def test_it_switches_at_its_band(two_plates: Maker) -> None:
    """An isolated plate is heated from below the band to its upper edge, once; the heat is stored to the joule."""
    heater = HEATER | {"region": "c", "T_on_K": 292.0, "T_off_K": 295.0}
    run = simulate(load_scenario(two_plates(thermostats=[heater])))
    power_W, temperature_K = run.record.values["H"], run.record.values["T_c"]
    last = int(np.flatnonzero(power_W)[-1])
    assert (power_W[: last + 1] == 60.0).all() and (power_W[last + 1 :] == 0.0).all()
    assert temperature_K[last] < 295.0 <= temperature_K[last + 1]
    stored_J = run.truth.capacity_J_per_K["c"] * (temperature_K[-1] - 290.0)
    assert power_W.sum() * 20.0 == pytest.approx(stored_J, rel=1e-9)


def test_side_by_side_they_switch_each_on_its_own(two_plates: Maker) -> None:
    scenarios = [load_scenario(two_plates(thermostats=[HEATER | {"T_off_K": t}], scenario=f"s{t}")) for t in (290, 292)]
    for together, scenario in zip(simulate_many(scenarios), scenarios, strict=True):
        np.testing.assert_array_equal(together.record.values["H"], simulate(scenario).record.values["H"])


def test_wrong_thermostats_are_named(two_plates: Maker) -> None:
    for change, message in (
        ({"T_on_K": 295.0}, r"thermostats\[0\]: T_on_K \(295\) must be below T_off_K \(290.2\)"),
        ({"region": "z"}, r"thermostats\[0\].region: unknown region 'z'"),
        ({"channel": "Q"}, r"thermostats\[0\].channel: 'Q' is declared twice"),
        ({"Q_W": -1.0}, r"thermostats\[0\].Q_W"),
    ):
        with pytest.raises(SpecError, match=message):
            load_scenario(two_plates(thermostats=[HEATER | change]))
