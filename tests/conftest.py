"""What every test shares: a clean environment, and a small twin of two nodes with telemetry."""

import copy
import faulthandler
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

PAIR: dict[str, Any] = {
    "twin": "pair",
    "boundaries": {"space": {"value_K": 2.7}},
    "channels": {
        "T_a": {"kind": "temperature", "unit": "degC"},
        "T_b": {"kind": "temperature", "unit": "K", "noise_std": 0.05},
        "Q_a": {"kind": "power", "unit": "W"},
    },
    "nodes": [
        {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 8.0e3}},
        {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"guess": 8.0e3}},
    ],
    "conductors": [{"between": ["a", "b"], "conductance_W_per_K": {"guess": 2.0}}],
    "radiators": [{"node": "a", "emissivity": 0.8, "area_m2": 0.2, "sink": "space"}],
    "loads": [{"channel": "Q_a", "node": "a"}],
}

END_S = 60.0
"""So long a run waits at its end for threads that a failed test has left behind."""


def pytest_unconfigure(config: pytest.Config) -> None:
    """End the process although threads go on that a failed test did not stop: Python would wait for them for ever."""

    def end() -> None:
        time.sleep(END_S)
        faulthandler.dump_traceback(all_threads=True)
        os._exit(pytest.ExitCode.INTERNAL_ERROR)

    threading.Thread(target=end, daemon=True).start()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse two tests with one id: a run in several processes would do one of them alone, in silence."""
    often = [name for name, count in Counter(item.nodeid for item in items).items() if count > 1]
    if often:
        raise pytest.UsageError(f"several tests are called {often[0]}; give each an id of its own")


@pytest.fixture(autouse=True)
def no_settings_from_outside() -> Iterator[None]:
    """Hide the TWIN_ settings of the machine, and drop those that a test leaves behind."""
    kept = {name: os.environ.pop(name) for name in list(os.environ) if name.startswith("TWIN_")}
    yield
    for name in [name for name in os.environ if name.startswith("TWIN_")]:
        del os.environ[name]
    os.environ.update(kept)


@pytest.fixture
def plugins_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the test load plug-ins with effects; what it loaded is forgotten behind it."""
    from twin_core.effects import REGISTRY, plugins

    monkeypatch.setattr(REGISTRY, "_kinds", {name: REGISTRY[name] for name in REGISTRY})
    monkeypatch.setattr(REGISTRY, "_sources", {})
    monkeypatch.setattr(plugins, "_LOADED", {})


@pytest.fixture(scope="session")
def pair_declared() -> dict[str, Any]:
    """A specification of two nodes, not to be changed."""
    return PAIR


@pytest.fixture
def pair() -> dict[str, Any]:
    """A specification of two nodes, to be changed at will."""
    return copy.deepcopy(PAIR)


@pytest.fixture(scope="session")
def pair_telemetry() -> Callable[[int], str]:
    """Return CSV text of so many rows of the pair: small Euler steps of its own heat balance, plus noise."""

    def make(n_rows: int) -> str:
        rng = np.random.default_rng(1)
        step_s, n_steps, sigma = 2.0, 30, 5.670374419e-8
        power_W = np.repeat(rng.choice([20.0, 60.0, 110.0], n_rows // 20 + 1), 20)[:n_rows]
        a_K = b_K = 270.0
        lines = ["time,T_a,T_b,Q_a"]
        for row in range(n_rows):
            noise = rng.normal(0.0, 0.05, 2)
            minutes = f"2026-01-{1 + row // 1440:02d}T{row // 60 % 24:02d}:{row % 60:02d}:00Z"
            lines.append(f"{minutes},{a_K - 273.15 + noise[0]:.4f},{b_K + noise[1]:.4f},{power_W[row]:g}")
            for _ in range(n_steps):
                exchange_W = 3.0 * (b_K - a_K)
                a_K += step_s / 1.1e4 * (power_W[row] + exchange_W + sigma * 0.16 * (2.7**4 - a_K**4))
                b_K -= step_s / 6.5e3 * exchange_W
        return "\n".join(lines) + "\n"

    return make
