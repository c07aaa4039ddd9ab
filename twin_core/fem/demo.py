"""The demonstration: a small spacecraft in orbit, one effect that nobody declared, and the operator's specification."""

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from twin_core.constants import DEEP_SPACE_K, SOLAR_CONSTANT_W_PER_M2
from twin_core.errors import SpecError
from twin_core.fem.materials import MATERIALS
from twin_core.fem.scenario import Scenario, load_scenario
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec

ORBIT_S = 5700.0
N_ORBITS = 14
DEPTH_M = 0.8
NODES = ("px", "mx", "pz", "box", "battery", "tank")
PAYLOADS = {"Q_pz": "pz", "Q_box": "box", "Q_battery": "battery", "Q_tank": "tank"}
SUNS = {"Q_sun_px": "px", "Q_sun_mx": "mx", "Q_sun_pz": "pz"}

_REGIONS: dict[str, tuple[tuple[float, float], tuple[float, float], str]] = {
    # Outer panels: heat-pipe panels with radiating faces, so that one temperature stands for a panel.
    "px": ((0.975, 1.0), (0.0, 0.8), "heat_pipe_panel"),
    "mx": ((0.0, 0.025), (0.0, 0.8), "graphite_doubler"),
    "pz": ((0.025, 0.975), (0.775, 0.8), "heat_pipe_panel"),
    "box": ((0.10, 0.40), (0.675, 0.775), "electronics_box"),
    "battery": ((0.85, 0.975), (0.15, 0.40), "battery_pack"),
    "tank": ((0.70, 0.85), (0.15, 0.40), "hydrazine_tank"),
}
_RADIATORS = {"px": ("px.right", 0.72, 0.64), "mx": ("mx.left", 0.68, 0.64), "pz": ("pz.top", 0.75, 0.76)}
_JOINTS = {
    # Pair -> contact conductance (bolted frames with washers, isolating mounts), length of the contact in metres.
    ("px", "pz"): (140.0, 0.025),
    ("mx", "pz"): (110.0, 0.025),
    ("box", "pz"): (16.0, 0.30),
    ("battery", "px"): (14.0, 0.25),
    ("tank", "battery"): (7.0, 0.25),
}
_STRAP = ("tank", "mx", 1.3)
_BUS = ("tank", 0.7)


def demo_scenario(effect: str, seed: int) -> tuple[Scenario, TwinSpec]:
    """Return the simulator's scenario with one hidden effect, and the specification that an operator would write.

    Parameters
    ----------
    effect
        A name of ``DEMO_EFFECTS``, "random" (drawn from the seed) or "none".
    seed
        Draws materials' scatter, loads, noise, the operator's guesses, and place and size of the effect.

    Raises
    ------
    SpecError
        If the effect is not one of them.
    """
    known = [*DEMO_EFFECTS, "random", "none"]
    if effect not in known:
        raise SpecError(f"effect: unknown effect '{effect}' (known: {', '.join(known)})")
    rng = np.random.default_rng([seed, 20])
    body = _body(seed, rng)
    operator = load_spec(_operator(body, rng))
    name = _drawn(seed) if effect == "random" else effect
    if name != "none":
        place = np.random.default_rng([seed, 22, zlib.crc32(name.encode())])
        body["hidden"] = [{"effect": name} | DEMO_EFFECTS[name](place, body)]
    return load_scenario(body), operator


def _drawn(seed: int) -> str:
    """Return the effect of a seed: shuffled anew for every eight seeds, so that eight in a row show each once."""
    names, (block, place) = list(DEMO_EFFECTS), divmod(seed, len(DEMO_EFFECTS))
    return names[int(np.random.default_rng([block, 21]).permutation(len(names))[place])]


def _body(seed: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return the scenario without hidden effect, contacts scattered by +-20 %."""
    scatter = rng.uniform(0.8, 1.2, len(_JOINTS) + 2)
    strap_a, strap_b, strap_G = _STRAP
    return {
        "scenario": "demo-orbits",
        "seed": seed,
        "depth_m": DEPTH_M,
        "mesh_size_m": 0.05,
        "initial_K": 275.0,
        "time": {
            "start": "2026-03-01T00:00:00Z",
            "duration_s": N_ORBITS * ORBIT_S,
            "step_s": 30.0,
            "sample_s": 60.0,
            "settle_s": 4.0 * ORBIT_S,
        },
        "regions": [{"id": n, "x_m": x, "y_m": y, "material": m} for n, (x, y, m) in _REGIONS.items()],
        "joints": [
            {"between": pair, "conductance_W_per_m2_K": float(h * s)}
            for (pair, (h, _)), s in zip(_JOINTS.items(), scatter, strict=False)
        ],
        "straps": [
            {"between": [f"{strap_a}.left", f"{strap_b}.right"], "conductance_W_per_K": float(strap_G * scatter[-2])}
        ],
        "boundaries": {"space": {"value_K": DEEP_SPACE_K}, "bus": {"forcing": "T_bus"}},
        "radiators": [{"surface": s, "emissivity": e, "sink": "space"} for s, e, _ in _RADIATORS.values()],
        "couplings": [{"place": _BUS[0], "boundary": "bus", "conductance_W_per_K": float(_BUS[1] * scatter[-1])}],
        "forcings": _forcings(rng),
        "loads": [{"forcing": q, "place": node} for q, node in PAYLOADS.items()]
        + [{"forcing": q, "place": _RADIATORS[node][0]} for q, node in SUNS.items()],
        "sensors": [{"channel": f"T_{node}", "region": node, "noise_std_K": 0.08} for node in NODES],
    }


def _forcings(rng: np.random.Generator) -> dict[str, Any]:
    """Return sun on three faces, switching payloads, the bus, and one auxiliary channel (a mode or an angle)."""
    absorptance = {"px": 0.26, "mx": 0.28, "pz": 0.24}
    phase_deg = {"px": 90.0, "mx": 270.0, "pz": 0.0}
    forcings: dict[str, Any] = {
        channel: {
            "kind": "power",
            "unit": "W",
            "signal": {
                "signal": "sun",
                "peak": round(absorptance[node] * SOLAR_CONSTANT_W_PER_M2 * _RADIATORS[node][2], 1),
                "period_s": ORBIT_S,
                "phase_deg": phase_deg[node],
                "eclipse_deg": 132.0,
            },
        }
        for channel, node in SUNS.items()
    }
    levels = {"Q_pz": (10, 60, 120), "Q_box": (30, 80, 150), "Q_battery": (15, 45, 90), "Q_tank": (0, 40, 90)}
    for channel, values in levels.items():
        signal = {"signal": "telegraph", "levels": values, "dwell_s": float(rng.uniform(2500.0, 5000.0))}
        forcings[channel] = {"kind": "power", "unit": "W", "signal": signal}
    forcings["T_bus"] = {
        "kind": "temperature",
        "unit": "K",
        "noise_std_K": 0.05,
        "signal": {"signal": "gaussian_process", "mean": 293.0, "std": 3.0, "correlation_length_s": 9000.0},
    }
    return forcings | (_MODE if rng.random() < 0.5 else _PITCH)


_MODE = {
    "mode": {
        "kind": "auxiliary",
        "levels": True,
        "signal": {"signal": "telegraph", "levels": [0, 1, 2], "dwell_s": 5200.0},
    }
}
_PITCH = {
    "pitch": {
        "kind": "auxiliary",
        "unit": "deg",
        "signal": {"signal": "slew", "between": [0.0, 180.0], "dwell_s": 3000.0, "rate_per_s": 0.05},
    }
}


def _operator(body: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Return the specification: right structure, capacities off by up to 40 %, conductors by up to a factor 2."""
    clean = load_scenario(body)
    channels = {name: channel.model_dump(exclude_none=True) for name, channel in clean.channels.items()}
    return {
        "twin": "demo",
        "boundaries": {"space": {"value_K": DEEP_SPACE_K}, "bus": {"channel": "T_bus"}},
        "channels": {name: _declared(channel) for name, channel in channels.items()},
        "nodes": [
            {
                "id": region.id,
                "sensor": f"T_{region.id}",
                "capacity_J_per_K": {
                    "guess": _rounded(
                        rng.uniform(0.6, 1.4)
                        * region.area_m2
                        * DEPTH_M
                        * MATERIALS[region.material].heat_capacity_J_per_m3_K
                    )
                },
            }
            for region in clean.regions
        ],
        "conductors": [
            {"between": pair, "conductance_W_per_K": {"guess": _rounded(2.0 ** rng.uniform(-1.0, 1.0) * G)}}
            for pair, G in _conductors()
        ],
        "radiators": [
            {"node": node, "emissivity": e, "area_m2": area, "sink": "space"}
            for node, (_, e, area) in _RADIATORS.items()
        ],
        "loads": [{"channel": q, "node": node} for q, node in (PAYLOADS | SUNS).items()],
        "criteria": {"bias_K": 1.0, "q99_abs_K": 3.0},
    }


def _declared(channel: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in channel.items() if value is not False}


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


def _conductors() -> list[tuple[tuple[str, str], float]]:
    """Return the declared conductors with their nominal values."""
    joints = [(pair, h * length * DEPTH_M) for pair, (h, length) in _JOINTS.items()]
    return [*joints, (_STRAP[:2], _STRAP[2]), ((_BUS[0], "bus"), _BUS[1])]


def _pick(rng: np.random.Generator, *names: str) -> str:
    return str(rng.choice(list(names)))


def _capacity(node: str) -> float:
    (x_low, x_high), (y_low, y_high), material = _REGIONS[node]
    return (x_high - x_low) * (y_high - y_low) * DEPTH_M * MATERIALS[material].heat_capacity_J_per_m3_K


def _radiation(rng: np.random.Generator, body: dict[str, Any]) -> dict[str, Any]:
    return {"node": _pick(rng, *NODES), "sink": "space", "R_m2": float(rng.uniform(0.06, 0.14))}


def _strap(rng: np.random.Generator, body: dict[str, Any]) -> dict[str, Any]:
    joined = {frozenset(pair) for pair, _ in _conductors()}
    pairs = [(a, b) for i, a in enumerate(NODES) for b in NODES[i + 1 :] if frozenset((a, b)) not in joined]
    return {"nodes": pairs[int(rng.integers(len(pairs)))], "G_W_per_K": float(rng.uniform(1.2, 3.0))}


def _leak(rng: np.random.Generator, body: dict[str, Any]) -> dict[str, Any]:
    nodes = [node for node in NODES if node != _BUS[0]]
    return {"node": _pick(rng, *nodes), "boundary": "bus", "G_W_per_K": float(rng.uniform(1.2, 3.0))}


def _constant(rng: np.random.Generator, body: dict[str, Any]) -> dict[str, Any]:
    return {"node": _pick(rng, *NODES), "Q_W": float(rng.uniform(15.0, 35.0))}


def _by_channel(rng: np.random.Generator, body: dict[str, Any]) -> dict[str, Any]:
    if "mode" in body["forcings"]:
        channel, knots = "mode", [0.0, 1.0, 2.0]
        values = [0.0, rng.uniform(15.0, 30.0), rng.uniform(35.0, 55.0)]
    else:
        channel, knots = "pitch", [0.0, 60.0, 120.0, 180.0]
        values = [0.0, rng.uniform(25.0, 40.0), rng.uniform(35.0, 50.0), rng.uniform(0.0, 15.0)]
    values_W = [float(value) for value in values]
    return {"node": _pick(rng, *NODES), "channel": channel, "knots": knots, "values_W": values_W}


def _heater(rng: np.random.Generator, body: dict[str, Any]) -> dict[str, Any]:
    # Set points lie a little above the usual mean of each node, so that the heater is at work part of the time.
    usual_K = {"px": 264.0, "mx": 262.0, "pz": 274.0, "box": 294.0, "battery": 283.0, "tank": 287.0}
    node = _pick(rng, *NODES)
    set_K = usual_K[node] + float(rng.uniform(0.0, 4.0))
    power_W = float(rng.uniform(30.0, 60.0))
    return {"node": node, "k_W_per_K": float(rng.uniform(4.0, 10.0)), "T_set_K": set_K, "Q_W": power_W}


def _gain(rng: np.random.Generator, body: dict[str, Any]) -> dict[str, Any]:
    g = rng.uniform(0.4, 0.65) if rng.random() < 0.6 else rng.uniform(1.35, 1.6)
    return {"channel": _pick(rng, *PAYLOADS, *SUNS), "g": float(g)}


def _mass(rng: np.random.Generator, body: dict[str, Any]) -> dict[str, Any]:
    node = _pick(rng, *NODES)
    capacity = float(rng.uniform(0.6, 1.2)) * _capacity(node)
    lag_s = float(rng.uniform(2500.0, 6000.0))
    return {"node": node, "C_J_per_K": capacity, "G_W_per_K": capacity / lag_s}


DEMO_EFFECTS: dict[str, Callable[[np.random.Generator, dict[str, Any]], dict[str, Any]]] = {
    "radiation_to_sink": _radiation,
    "missing_conductor": _strap,
    "leak_to_boundary": _leak,
    "constant_heat_load": _constant,
    "channel_heat_load": _by_channel,
    "proportional_heater": _heater,
    "input_gain": _gain,
    "hidden_mass": _mass,
}
"""Effects that the demonstration can hide: name -> draws its place and size."""
