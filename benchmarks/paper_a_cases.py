"""The data of paper A: records of its test cases, the networks fitted to them, and how a fit is scored."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline

from twin_core.calibrate.problem import build_problem
from twin_core.calibrate.second_order import Calibration
from twin_core.calibrate.statistics import pearson, score
from twin_core.fem.paper import (
    CONFIGURATIONS,
    CORRELATION_LENGTH_S,
    EMISSIVITY,
    ORBIT_S,
    SENSORS,
    paper_scenario,
    paper_spec,
)
from twin_core.fem.simulate import Simulation, simulate_many
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

TRAIN_ORBITS, ALL_ORBITS = 12.0, 15.0
"""Training and validation together, as the paper's method sees them; the rest is the test."""

SIDES = ("left", "right", "bottom", "top")


@cache
def simulations() -> dict[tuple[str, str], Simulation]:
    """Return (configuration, test) -> run, all of them side by side on one factorisation."""
    keys = [(c, t) for c in CONFIGURATIONS for t in CORRELATION_LENGTH_S]
    return dict(
        zip(keys, simulate_many([paper_scenario(test, configuration) for configuration, test in keys]), strict=True)
    )


def every_second(record: Record) -> Record:
    """Return a record at one sample a second: the paper's times per epoch are those of one step a second.

    Inputs are linear between samples anyway; temperatures are smooth, and follow a cubic spline.
    """
    time_s = np.arange(record.time_s[0], record.time_s[-1] + 0.5)
    values = {
        name: CubicSpline(record.time_s, c)(time_s) if name.startswith("T_") else np.interp(time_s, record.time_s, c)
        for name, c in record.values.items()
    }
    return replace(record, time_s=time_s, values=values)


def noisy(simulation: Simulation, fraction: float, seed: int) -> Record:
    """Return the record with white noise of a fraction of the mean temperature on every reading (section 5.6)."""
    record, rng = simulation.record, np.random.default_rng(seed)
    mean_K = float(np.mean([record.values[f"T_{name}"] for name in SENSORS]))
    extra = {
        f"T_{n}": record.values[f"T_{n}"] + rng.normal(0.0, fraction * mean_K, record.time_s.size) for n in SENSORS
    }
    return replace(record, values={**record.values, **extra})


def training(record: Record) -> Record:
    """Return what a calibration sees."""
    return record.between(0.0, TRAIN_ORBITS * ORBIT_S)


@dataclass(frozen=True)
class Score:
    """Errors of an open-loop rollout.

    Attributes
    ----------
    train, test
        Root mean square error as a fraction of the mean temperature.
    test_K
        The same in kelvin.
    pcc, pooled_pcc
        Pearson correlation over the test (eq. 14): mean over the sensors, and all readings together.
    """

    train: float
    test: float
    test_K: float
    pcc: float
    pooled_pcc: float


def score_of(calibration: Calibration, record: Record, against: Record | None = None) -> Score:
    """Roll a fit through training and test from its one initial state, never corrected, and score it.

    ``against`` holds other readings to compare with, such as those without noise.
    """
    spec = calibration.network.spec
    problem = build_problem(calibration.problem.network, [record], calibration.problem.noise_K, calibration.max_step_s)
    n_first = problem.n_unknowns
    predicted = problem.solve(calibration.optimum.unknowns[:n_first]).predicted_K[0]
    readings = (against or record).values
    measured = np.stack([readings[s] for s in spec.sensors], axis=1)
    late = record.time_s >= TRAIN_ORBITS * ORBIT_S
    mean_K = float(measured.mean())
    train = score(spec.sensors, [measured[~late]], [predicted[~late]])["rmse_K"]
    test = score(spec.sensors, [measured[late]], [predicted[late]])
    pooled = pearson(measured[late].ravel(), predicted[late].ravel()) or 0.0
    return Score(train / mean_K, test["rmse_K"] / mean_K, test["rmse_K"], test["pcc"], pooled)


def unsensed_spec() -> TwinSpec:
    """Return a network with 19 unsensed nodes: the section in 4 x 4 cells, each side in three surfaces.

    Capacities and conductances are rough guesses of the plate alone: nothing is told of the units inside.
    """
    inside = {(i, j): f"cell_{i}{j}" for i in range(4) for j in range(4)}
    inside |= {(0, 2): "payload_1", (1, 2): "payload_2", (2, 2): "battery_1", (3, 2): "battery_2", (2, 1): "tank_1"}
    surface = {side: [f"{side}_a", side, f"{side}_b"] for side in SIDES}
    weights = (0.25, 0.5, 0.25)
    nodes = [{"id": name, "capacity_J_per_K": {"guess": 5.2e4}} for name in inside.values()]
    nodes += [
        {"id": n, "capacity_J_per_K": {"guess": 4.0e4 * w}}
        for s in SIDES
        for n, w in zip(surface[s], weights, strict=True)
    ]
    nodes = [n | ({"sensor": f"T_{n['id']}"} if n["id"] in SENSORS else {}) for n in nodes]
    declared = paper_spec().model_dump(mode="json", exclude_none=True)
    return load_spec(
        {
            "twin": "paper-unsensed",
            "boundaries": declared["boundaries"],
            "channels": declared["channels"],
            "nodes": nodes,
            "conductors": [
                {"between": [a, b], "conductance_W_per_K": {"guess": g}} for a, b, g in _edges(inside, surface)
            ],
            "radiators": [
                {"node": n, "emissivity": EMISSIVITY, "area_m2": 2.0 * w, "sink": "space"}
                for s in SIDES
                for n, w in zip(surface[s], weights, strict=True)
            ],
            "loads": [
                {"channel": f"Q_{s}", "node": n, "weight": w}
                for s in SIDES
                for n, w in zip(surface[s], weights, strict=True)
            ]
            + [load for load in declared["loads"] if load["node"] not in SIDES],
        }
    )


def _edges(inside: dict[tuple[int, int], str], surface: dict[str, Sequence[str]]) -> list[tuple[str, str, float]]:
    """Return neighbours with the conductance of a plate of one square, of half a square, and of a narrow strip."""
    edges = [(inside[i, j], inside[i + 1, j], 30.0) for i in range(3) for j in range(4)]
    edges += [(inside[i, j], inside[i, j + 1], 30.0) for i in range(4) for j in range(3)]
    rim = {
        "left": [inside[0, j] for j in range(4)],
        "right": [inside[3, j] for j in range(4)],
        "bottom": [inside[i, 0] for i in range(4)],
        "top": [inside[i, 3] for i in range(4)],
    }
    for side, cells in rim.items():
        a, centre, b = surface[side]
        edges += [(a, cells[0], 60.0), (centre, cells[1], 60.0), (centre, cells[2], 60.0), (b, cells[3], 60.0)]
        edges += [(a, centre, 5.0), (centre, b, 5.0)]
    corners = [("left_a", "bottom_a"), ("left_b", "top_a"), ("right_a", "bottom_b"), ("right_b", "top_b")]
    return [*edges, *((a, b, 5.0) for a, b in corners)]
