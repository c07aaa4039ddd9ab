"""A box whose panel looks to space through a louver that nobody declared: SciPy's truth, and the plug-in that knows louvers."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

PLUGIN = Path(__file__).parents[1] / "examples" / "effects" / "louver.py"
AREA_M2, SHUT_K, RANGE_K = 0.12, 276.0, 10.0
"""Effective area of the open louver, and where its blades begin to open and how far from there they are open."""

SIGMA, STEP_S, NOISE_K = 5.670374419e-8, 60.0, 0.05
SPEC: dict[str, Any] = {
    "twin": "louvered",
    "boundaries": {"space": {"value_K": 2.7}},
    "channels": {
        "T_box": {"kind": "temperature", "unit": "K"},
        "T_panel": {"kind": "temperature", "unit": "K"},
        "Q_box": {"kind": "power", "unit": "W"},
    },
    "nodes": [
        {"id": "box", "sensor": "T_box", "capacity_J_per_K": {"guess": 8.0e3}},
        {"id": "panel", "sensor": "T_panel", "capacity_J_per_K": {"guess": 6.0e3}},
    ],
    "conductors": [{"between": ["box", "panel"], "conductance_W_per_K": {"guess": 3.0}}],
    "radiators": [{"node": "panel", "emissivity": 0.8, "area_m2": 0.1, "sink": "space"}],
    "loads": [{"channel": "Q_box", "node": "box"}],
}


def telemetry(n_times: int) -> dict[str, np.ndarray]:
    """Return times and channels: the power steps at random, and the panel swings through the blades' range."""
    rng = np.random.default_rng(0)
    time_s = STEP_S * np.arange(n_times)
    power_W = rng.choice([10.0, 40.0, 70.0, 110.0], n_times // 25 + 1).repeat(25)[:n_times]

    def rates(t: float, y: np.ndarray, heated_W: float) -> list[float]:
        box, panel = y
        opening = min(max((panel - SHUT_K) / RANGE_K, 0.0), 1.0)
        exchanged = 4.0 * (panel - box)
        radiated = SIGMA * (0.08 + AREA_M2 * opening) * (2.7**4 - panel**4)
        return [(heated_W + exchanged) / 6.0e3, (radiated - exchanged) / 9.0e3]

    states = [np.array([275.0, 270.0])]
    for heated_W in power_W[:-1]:
        step = solve_ivp(rates, (0.0, STEP_S), states[-1], args=(heated_W,), rtol=1e-8, atol=1e-8)
        states.append(step.y[:, -1])
    read = np.array(states) + rng.normal(0.0, NOISE_K, (n_times, 2))
    return {"time_s": time_s, "T_box": read[:, 0], "T_panel": read[:, 1], "Q_box": power_W}


def csv(n_times: int) -> str:
    """Return the telemetry as a CSV file."""
    columns = telemetry(n_times)
    rows = (",".join(f"{x:.6g}" for x in row) for row in zip(*columns.values(), strict=True))
    return "\n".join([",".join(columns), *rows]) + "\n"
