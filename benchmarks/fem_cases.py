"""Finite-element orbits with any undeclared effect: truth that is no lumped network."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from benchmarks.case import Case, Truth, trace_of
from twin_core.fem.demo import DEMO_EFFECTS, NODES, PAYLOADS, SUNS, demo_scenario
from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import Simulation, simulate

_JOINED = [("px", "pz"), ("mx", "pz"), ("box", "pz"), ("battery", "px"), ("tank", "battery")]
_PANELS = ["px", "mx", "pz"]

Clean = dict[str, np.ndarray]
"""Temperature of every node without the effect, (n_times,)."""
Draw = Callable[[np.random.Generator, Clean, float], dict[str, Any]]


def _choice(rng: np.random.Generator, options: list[Any]) -> Any:
    return options[int(rng.integers(len(options)))]


def _either(rng: np.random.Generator, low: tuple[float, float], high: tuple[float, float]) -> float:
    """Return a number from one of two ranges: smaller or larger than what is declared."""
    return float(rng.uniform(*(low if rng.random() < 0.5 else high)))


def _onset(rng: np.random.Generator, duration_s: float) -> float:
    return float(rng.uniform(0.15, 0.5) * duration_s)


def _exchange(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    pairs = [(a, b) for i, a in enumerate(NODES) for b in NODES[i + 1 :] if abs(clean[a].mean() - clean[b].mean()) > 5]
    return {"nodes": list(_choice(rng, pairs)), "R_m2": float(rng.uniform(0.3, 0.8))}


def _convection(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    node = _choice(rng, list(NODES))
    return {"node": node, "boundary": "bus", "k": float(rng.uniform(0.15, 0.4)), "p": float(rng.uniform(1.5, 2.0))}


def _periodic(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    size, phase = float(rng.uniform(15, 35)), float(rng.uniform(0, 2 * np.pi))
    wave = {"A_W": size * float(np.cos(phase)), "B_W": size * float(np.sin(phase))}
    period = float(np.exp(rng.uniform(np.log(2500), np.log(15000))))
    return {"node": _choice(rng, list(NODES)), "Q_W": float(rng.uniform(0, 15)), **wave, "P_s": period}


def _thermostat(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    node = _choice(rng, list(NODES))
    low = float(np.quantile(clean[node], rng.uniform(0.4, 0.7)))
    band = float(rng.uniform(1.5, 4.0))
    return {"node": node, "Q_W": float(rng.uniform(40, 80)), "T_on_K": low, "T_off_K": low + band}


def _capacity(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    node = _choice(rng, _PANELS)
    return {"node": node, "kappa_per_K": _either(rng, (-0.012, -0.008), (0.008, 0.015)), "T_ref_K": 270.0}


def _latent(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    node = _choice(rng, _PANELS)
    melting = float(np.quantile(clean[node], rng.uniform(0.35, 0.65)))
    return {"node": node, "L_J": float(rng.uniform(4e4, 9e4)), "T_m_K": melting, "w_K": float(rng.uniform(0.8, 2.0))}


def _input_step(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    channel = _choice(rng, [*PAYLOADS, *SUNS])
    f = 0.0 if rng.random() < 0.3 else _either(rng, (0.3, 0.7), (1.3, 1.6))
    return {"channel": channel, "f": f, "time": _onset(rng, duration_s)}


def _input_drift(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    return {"channel": _choice(rng, [*PAYLOADS, *SUNS]), "r_per_s": _either(rng, (-0.7, -0.4), (0.4, 0.8)) / duration_s}


def _power_law(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    return {"channel": _choice(rng, list(PAYLOADS)), "n": _either(rng, (0.5, 0.75), (1.4, 1.8)), "reference": 80.0}


def _conductance_step(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    f = _either(rng, (0.3, 0.6), (1.6, 2.5))
    return {"nodes": list(_choice(rng, _JOINED)), "f": f, "time": _onset(rng, duration_s)}


def _conductance_slope(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    pair = _choice(rng, _JOINED)
    mean = float(np.mean([clean[n].mean() for n in pair]))
    return {"nodes": list(pair), "beta_per_K": _either(rng, (-0.02, -0.01), (0.015, 0.03)), "T_ref_K": mean}


def _emissivity_step(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    place = {"node": _choice(rng, _PANELS), "sink": "space"}
    return {**place, "f": _either(rng, (0.6, 0.85), (1.12, 1.25)), "time": _onset(rng, duration_s)}


def _bias(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    sensor, size = f"T_{_choice(rng, list(NODES))}", _either(rng, (-2.5, -0.8), (0.8, 2.5))
    return {"sensor": sensor, "b_K": size, "time": _onset(rng, duration_s)}


def _drift(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    size = _either(rng, (-5.0, -2.0), (2.0, 5.0))
    return {"sensor": f"T_{_choice(rng, list(NODES))}", "d_K_per_s": size / duration_s}


def _lag(rng: np.random.Generator, clean: Clean, duration_s: float) -> dict[str, Any]:
    return {"sensor": f"T_{_choice(rng, list(NODES))}", "tau_s": float(rng.uniform(300, 900))}


FURTHER: dict[str, Draw] = {
    "radiative_exchange": _exchange,
    "nonlinear_convection": _convection,
    "periodic_heat_load": _periodic,
    "thermostat_heater": _thermostat,
    "capacity_temperature": _capacity,
    "latent_heat": _latent,
    "input_step": _input_step,
    "input_drift": _input_drift,
    "input_power_law": _power_law,
    "conductance_step": _conductance_step,
    "conductance_temperature": _conductance_slope,
    "emissivity_step": _emissivity_step,
    "sensor_bias": _bias,
    "sensor_drift": _drift,
    "sensor_lag": _lag,
}
"""Effects beyond those of the demonstration: name -> draws place and size from what the clean spacecraft does."""

FEM_EFFECTS = (*DEMO_EFFECTS, *FURTHER)


def fem_case(effect: str | None, seed: int) -> Case:
    """Return a seeded spacecraft in orbit with one effect hidden in its field; None hides nothing."""
    if effect is None or effect in DEMO_EFFECTS:
        scenario, spec = demo_scenario(effect or "none", seed)
    else:
        scenario, spec = demo_scenario("none", seed)
        rng = np.random.default_rng([seed, 31, *effect.encode()])
        drawn = {"effect": effect, **FURTHER[effect](rng, _clean(seed), scenario.time.duration_s)}
        scenario = load_scenario(scenario.model_dump(mode="json", exclude_none=True) | {"hidden": [drawn]})
    done = simulate(scenario)
    record, noise_K = done.record, scenario.sensors[0].noise_std_K
    truths: tuple[Truth, ...] = ()
    if effect is not None:
        hidden = scenario.hidden[0]
        # The noise of a seed is the same whatever is hidden: the difference is the effect's own.
        moved = np.stack([record.values[f"T_{node}"] - _clean(seed)[node] for node in NODES], axis=1)
        onset_s = hidden.parameters.get("time")
        truths = (Truth(effect, hidden.where, hidden.parameters, onset_s, trace_of(moved, noise_K)),)
    return Case(spec, record, truths, _node_temperatures(done), noise_K)


@lru_cache(maxsize=4)
def _clean(seed: int) -> Clean:
    done = simulate(demo_scenario("none", seed)[0])
    return {node: done.record.values[f"T_{node}"] for node in NODES}


def _node_temperatures(done: Simulation) -> np.ndarray:
    """Return the sensors' noise-free readings, (n_times, n_nodes)."""
    fine = done.truth
    return np.stack([np.interp(done.record.time_s, fine.time_s, fine.temperature_K[f"T_{n}"]) for n in NODES], axis=1)
