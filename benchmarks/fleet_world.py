"""A design of spacecraft for the benchmarks of a fleet: a ring of nine nodes, each spacecraft with parameters of its own."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_core.calibrate.result import CalibratedModel
from twin_core.network.model import build_network
from twin_core.network.spec import TwinSpec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

N_NODES, N_LOADS = 9, 3
ORBIT_S, NOISE_K, MISFIT_K = 5700.0, 0.1, 0.05
SPREAD = 0.1
"""Standard deviation of the logarithm of each parameter over the spacecraft of the design."""


def specification(name: str) -> dict[str, Any]:
    """Return a spacecraft: a ring of nodes, three of which radiate to space and are heated."""
    nodes = [f"n{k}" for k in range(N_NODES)]
    temperature, power = {"kind": "temperature", "unit": "K"}, {"kind": "power", "unit": "W"}
    return {
        "twin": name,
        "family": "ring",
        "boundaries": {"space": {"value_K": 2.7}},
        "channels": {f"T{k}": temperature for k in range(N_NODES)} | {f"Q{k}": power for k in range(N_LOADS)},
        "nodes": [
            {"id": node, "sensor": f"T{k}", "capacity_J_per_K": {"guess": 5e3 + 500.0 * k}}
            for k, node in enumerate(nodes)
        ],
        "conductors": [
            {"between": [nodes[k], nodes[(k + 1) % N_NODES]], "conductance_W_per_K": {"guess": 2.0 + 0.1 * k}}
            for k in range(N_NODES)
        ],
        "radiators": [
            {"node": nodes[3 * k], "emissivity": 0.8, "area_m2": 0.12, "sink": "space"} for k in range(N_LOADS)
        ],
        "loads": [{"channel": f"Q{k}", "node": nodes[3 * k]} for k in range(N_LOADS)],
    }


def model_of(spec: TwinSpec, rng: np.random.Generator) -> CalibratedModel:
    """Return the true network of one spacecraft of the design."""
    network = build_network(spec)
    values = {p.name: p.value for p in network.parameters.parameters}
    values |= {
        name: values[name] * float(np.exp(rng.normal(0.0, SPREAD))) for name in values if name[:2] in ("C:", "G:")
    }
    each = spec.sensors
    misfit = (dict.fromkeys(each, NOISE_K), dict.fromkeys(each, MISFIT_K), dict.fromkeys(each, 3000.0))
    return CalibratedModel(spec, (), values, np.zeros((0, 0)), (), *misfit, 60.0)


def flight(
    model: CalibratedModel, time_s: NDArray[np.float64], rng: np.random.Generator
) -> dict[str, NDArray[np.float64]]:
    """Return what the spacecraft reads at some instants, after an orbit in which it comes to its rhythm."""
    before_s = np.arange(0.0, ORBIT_S, 60.0) - ORBIT_S + time_s[0]
    every_s = np.concatenate([before_s, time_s])
    phase = rng.uniform(0.0, 2.0 * np.pi)
    orbit = 2.0 * np.pi * every_s / ORBIT_S + phase
    loads = {f"Q{k}": 45.0 + 15.0 * (np.sin(orbit + k) > -0.2) + 5.0 * k for k in range(N_LOADS)}
    network = model.network()
    blank = {sensor: np.full(every_s.size, 290.0) for sensor in model.spec.sensors}
    forcing = build_forcing(network, Record(every_s, blank | loads), model.max_step_s)
    path = rollout(network, network.parameters.values, np.full(N_NODES, 290.0), forcing)
    states = path.at_samples(forcing.sample_step)[before_s.size :]
    readings = states + rng.normal(0.0, NOISE_K, states.shape)
    columns = {sensor: readings[:, k] for k, sensor in enumerate(model.spec.sensors)}
    return columns | {name: column[before_s.size :] for name, column in loads.items()}
