"""Two bodies whose sensors sit off the mean of their node, in closed form, and the dense covariance of what is fitted to them."""

from typing import Any

import numpy as np

from tests.analytic import laplacian, linear_states
from tests.helpers import conductive_spec, record_of
from twin_core._typing import FloatArray
from twin_core.calibrate.gradients import BIOT, WithGradients
from twin_core.telemetry import Record

NOISE_K = 0.05
CAPACITY_J_PER_K = np.array([4.0e3, 7.0e3])
G_W_PER_K, LEAK_W_PER_K, ROOM_K = 2.5, 1.5, 280.0
OFF = np.array([0.08, -0.1, 0.12, 0.06])
"""b_l of the conductor and the load at n0, of the conductor and the leak at n1."""


def spec() -> dict[str, Any]:
    data = conductive_spec(
        2,
        [(0, 1)],
        channels={"Q": {"kind": "power", "unit": "W"}},
        loads=[{"channel": "Q", "node": "n0"}],
        boundaries={"room": {"value_K": ROOM_K}},
    )
    data["conductors"].append({"between": ["n1", "room"], "conductance_W_per_K": {"guess": 1.0}})
    for sensor in ("T0", "T1"):
        data["channels"][sensor]["noise_std"] = NOISE_K
    return data


def off_the_mean_K(states_K: FloatArray, power_W: FloatArray, off: FloatArray = OFF) -> FloatArray:
    """Return what the sensors read beside the mean of their node, (n_times, 2), by the b_l of ``OFF``."""
    through, lost = G_W_PER_K * (states_K[:, 1] - states_K[:, 0]), LEAK_W_PER_K * (ROOM_K - states_K[:, 1])
    first = (off[0] * through + off[1] * power_W) / G_W_PER_K
    second = (off[2] * -through + off[3] * lost) / (G_W_PER_K + LEAK_W_PER_K)
    return np.stack([first, second], axis=1)


def record(share: float, heat_W: float = 0.0, off: FloatArray = OFF, seed: int = 3) -> Record:
    """Return readings of which a share of the gradients is seen; the heat of a step is seen at its end.

    ``heat_W`` is undeclared, sets no gradients up, and acts at n0; ``off`` as ``OFF``.
    """
    rng = np.random.default_rng(seed)
    time_s, power = 60.0 * np.arange(400), np.repeat(rng.choice([0.0, 40.0, 90.0], 40), 10)
    rates = -(laplacian(2, [(0, 1)], [G_W_PER_K]) + np.diag([0.0, LEAK_W_PER_K])) / CAPACITY_J_PER_K[:, None]
    drive = np.stack([power + heat_W, np.full(400, LEAK_W_PER_K * ROOM_K)], axis=1) / CAPACITY_J_PER_K
    states = linear_states(rates, drive, np.array([290.0, 288.0]), time_s)
    seen = np.concatenate([power[:1], power[:-1]])
    read = states + share * off_the_mean_K(states, seen, off) + rng.normal(0.0, NOISE_K, (400, 2))
    return record_of(time_s, Q=power, T0=read[:, 0], T1=read[:, 1])


def dense_covariance(found: WithGradients) -> FloatArray:
    """Return the covariance of the unknowns where gradients of any size are part of the noise, (n_unknowns, n_unknowns)."""
    _, std = found.problem.prior()
    (block,) = found.problem.jacobian_blocks(found.optimum.unknowns, found.optimum.fit)
    precision = np.diag(1.0 / std**2)
    for sensor, flows in enumerate(found.flows_K):
        noise = found.whitener.models[sensor]
        apart_s = np.abs(found.whitener.time_s[:, None] - found.whitener.time_s)
        coloured = noise.sigma_ou**2 * np.exp(-apart_s / noise.length_s)
        covariance = noise.sigma_white**2 * np.eye(len(flows)) + coloured + BIOT**2 * flows @ flows.T
        precision += block[:, sensor].T @ np.linalg.solve(covariance, block[:, sensor])
    return np.linalg.inv(precision)
