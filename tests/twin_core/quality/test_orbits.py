"""Clean orbits of the finite-element simulator lose nothing, however they are sampled."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import simulate
from twin_core.quality import screen
from twin_core.telemetry import Record

SCENARIOS = Path(__file__).parents[3] / "examples" / "scenarios"
SAMPLED_S = (10, 20, 30, 60, 100, 150, 200, 300)


@pytest.fixture(scope="module")
def orbits() -> Record:
    """Three revolutions of the example, without noise and hidden effects, every 10 s."""
    body: dict[str, Any] = yaml.safe_load((SCENARIOS / "polar-orbit.yaml").read_text())
    body["hidden"] = []
    body["mesh_size_m"] = 0.1
    body["time"] |= {"duration_s": 17_700, "step_s": 10, "sample_s": 10, "settle_s": 5900}
    for sensor in body["sensors"]:
        sensor["noise_std_K"] = 0.0
    return simulate(load_scenario(body)).record


@pytest.mark.parametrize("sample_s", SAMPLED_S)
@pytest.mark.parametrize(("noise_K", "step_K"), [(0.0, 0.0), (0.05, 0.0), (0.0, 0.25), (0.05, 0.1), (0.3, 0.5)])
def test_no_reading_is_lost(orbits: Record, sample_s: int, noise_K: float, step_K: float) -> None:
    rng = np.random.default_rng(sample_s)
    every = slice(None, None, sample_s // 10)
    columns, units = {}, {}
    for name, column in orbits.values.items():
        is_temperature = name.startswith("T_")
        values = column[every] + rng.normal(0.0, noise_K if is_temperature else 0.0, column[every].size)
        columns[name] = np.round(values / step_K) * step_K if is_temperature and step_K else values
        units[name] = "K" if is_temperature else "W"
    assert screen(orbits.time_s[every], columns, units).masks == {}
