"""Clean orbits of the finite-element simulator lose nothing, however they are sampled."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import simulate
from twin_core.quality import screen
from twin_core.telemetry import Record

Masks = Mapping[str, Mapping[str, np.ndarray]]
SCENARIOS = Path(__file__).parents[3] / "examples" / "scenarios"
SAMPLED_S = (10, 20, 30, 60, 100, 150, 200, 300)


LIGHT = {"conductivity_W_per_m_K": 8.0, "density_kg_per_m3": 30.0, "specific_heat_J_per_kg_K": 900.0}
"""Of a light panel: 540 J/K on each square metre, which follows the Sun within two minutes and peaks once in an orbit."""


def simulated(**changes: Any) -> Record:
    """Return three revolutions of the example, without noise and hidden effects, every 10 s."""
    body: dict[str, Any] = yaml.safe_load((SCENARIOS / "polar-orbit.yaml").read_text())
    for region in body["regions"]:
        region["material"] = changes.get(region["id"], region["material"])
    body["materials"] = {"light": LIGHT}
    body["hidden"] = []
    body["mesh_size_m"] = 0.1
    body["time"] |= {"duration_s": 17_700, "step_s": 10, "sample_s": 10, "settle_s": 5900}
    for sensor in body["sensors"]:
        sensor["noise_std_K"] = 0.0
    return simulate(load_scenario(body)).record


@pytest.fixture(scope="module")
def orbits() -> Record:
    return simulated()


@pytest.fixture(scope="module")
def light() -> Record:
    return simulated(zenith="light", nadir="light", cold="light", warm="light")


def screened(record: Record, sample_s: int, noise_K: float, step_K: float) -> Masks:
    """Return what is masked of a record that is sampled, noisy and quantised so."""
    rng = np.random.default_rng(sample_s)
    every = slice(None, None, sample_s // 10)
    columns, units = {}, {}
    for name, column in record.values.items():
        is_temperature = name.startswith("T_")
        values = column[every] + rng.normal(0.0, noise_K if is_temperature else 0.0, column[every].size)
        columns[name] = np.round(values / step_K) * step_K if is_temperature and step_K else values
        units[name] = "K" if is_temperature else "W"
    return screen(record.time_s[every], columns, units).masks


@pytest.mark.parametrize("sample_s", SAMPLED_S)
@pytest.mark.parametrize(("noise_K", "step_K"), [(0.0, 0.0), (0.05, 0.0), (0.0, 0.25), (0.05, 0.1), (0.3, 0.5)])
def test_no_reading_is_lost(orbits: Record, sample_s: int, noise_K: float, step_K: float) -> None:
    assert screened(orbits, sample_s, noise_K, step_K) == {}


@pytest.mark.parametrize("sample_s", SAMPLED_S)
@pytest.mark.parametrize(("noise_K", "step_K"), [(0.0, 0.0), (0.05, 0.0), (0.05, 0.1), (0.3, 0.5)])
def test_no_peak_of_a_light_panel_is_lost(light: Record, sample_s: int, noise_K: float, step_K: float) -> None:
    assert np.ptp(light.values["T_zenith"]) > 25.0  # it follows the Sun, and peaks once in an orbit
    assert screened(light, sample_s, noise_K, step_K) == {}


@pytest.mark.parametrize("sample_s", SAMPLED_S)
def test_no_coarse_reading_without_noise_is_a_spike(light: Record, sample_s: int) -> None:
    """Coarse steps without any noise can rest in the shadow so long that they look frozen; nothing of them spikes."""
    assert all("spike" not in reasons for reasons in screened(light, sample_s, 0.0, 0.25).values())
