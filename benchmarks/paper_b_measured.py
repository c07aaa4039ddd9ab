"""Section IV-B on the paper's own rig: three blocks, nylon pads, one heater, 24 hours in room air.

The network is lumped per block (mean of its sound sensors), with the capacities, areas and conductances that were
published with the record, or fitted to the training part. The convection is learned on the first hours as in the paper
and used open-loop on the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from twin_core._typing import FloatArray
from twin_core.gp.kernels import Matern, Values
from twin_core.gp.polynomial import ForcePolynomial
from twin_core.latent_force.hyperparameters import MapFit, fit_map
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.posterior import GammaPrior
from twin_core.latent_force.regression import LearnedHeatFlow, learn_heat_flow
from twin_core.latent_force.smooth import smooth_force

FILE = "three_block_24h.csv"
CAPACITY = np.array([1381.8, 639.2, 222.6])
AREA_M2 = np.array([5 * 65.97e-4, 4 * 54.98e-4, 3 * 36.65e-4])
PAD_M2 = np.pi / 4.0 * (0.07**2 - 0.05**2)
PUBLISHED = {"G12_W_per_K": 0.2717 * PAD_M2 / 1e-3, "G23_W_per_K": 0.218 * PAD_M2 / 2e-3, "h_W_per_m2K": 7.7525}
CAPACITIES = dict(zip(("C1_J_per_K", "C2_J_per_K", "C3_J_per_K"), CAPACITY, strict=True))
NOISE_K = 2e-3
"""Sensor noise of the 20 s means, with what differs between the sensors of a block."""
DRIFT_K2_PER_S = 1e-9
"""White noise in dT/dt while conductances are fitted without a latent force."""
PRIORS = {"std": GammaPrior(2.0, 2.0), "length_s": GammaPrior(2.0, 1e-3)}
KERNEL = Matern(1, decay=float(np.sqrt(3.0)))


@dataclass(frozen=True)
class Rig:
    """The record: block means (n_times, 3) and ambient (n_times,) in degC, heater (n_times,) in W."""

    time_s: FloatArray
    blocks: FloatArray
    ambient: FloatArray
    heater_W: FloatArray

    def part(self, start: int, stop: int) -> "Rig":
        """Return the samples start <= k < stop."""
        rows = slice(start, stop)
        return Rig(self.time_s[rows], self.blocks[rows], self.ambient[rows], self.heater_W[rows])


@dataclass(frozen=True)
class Case:
    """One network, trained on the first hours: errors per block without and with the learned convection.

    ``outside`` is the share of the test, over times and blocks, at which a curve is used beyond what it was learned over.
    """

    network: str
    train_h: float
    where: str
    rms_without: FloatArray
    rms_with: FloatArray
    outside: float
    learned: LearnedHeatFlow
    force_std_W: float
    values: FloatArray


def slice_errors(rig: Rig, case: Case, n_slices: int = 12) -> list[tuple[float, bool, FloatArray, FloatArray]]:
    """Return, for each of so many equal slices of the record, what a trained network makes of it from its own first sample.

    Each is (hour at which it begins, whether it is held out, RMS per block without and with the learned convection).
    """
    edges = np.linspace(0, rig.time_s.size, n_slices + 1).round().astype(int)
    found = []
    for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = rig.part(start, stop)
        bare, curved = (_rms(part, open_loop(part, case.values, c)) for c in ((), case.learned.polynomials))
        begin_h = float(part.time_s[0] - rig.time_s[0]) / 3600.0
        found.append((begin_h, begin_h >= case.train_h - 1e-6, bare, curved))
    return found


def load(folder: Path) -> Rig:
    """Read the record."""
    table = pd.read_csv(folder / FILE)
    blocks = [table[[c for c in table.columns if c.startswith(f"T_block{b}_")]].mean(axis=1) for b in (1, 2, 3)]
    return Rig(
        table["time_s"].to_numpy(dtype=np.float64),
        np.stack([b.to_numpy(dtype=np.float64) for b in blocks], axis=1),
        table["T_ambient_degC"].to_numpy(dtype=np.float64),
        table["P_block1_W"].to_numpy(dtype=np.float64),
    )


def network(rig: Rig, values: Values) -> Linearised:
    """Return the three blocks at G12, G23, h and, where given, the capacities."""
    g12, g23, h = values[:3]
    capacity = values[3:6] if len(values) == 6 else CAPACITY
    join = np.array([[-1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    balance = g12 * join + g23 * join[::-1, ::-1] - h * np.diag(AREA_M2)
    ends = np.stack([rig.ambient[:-1], rig.ambient[1:]], axis=1)[:, :, None]
    inputs = ends * h * AREA_M2 + rig.heater_W[:-1, None, None] * np.array([1.0, 0.0, 0.0])
    return Linearised(rig.time_s, (balance / capacity[:, None])[None], inputs / capacity, np.atleast_2d(capacity))


def model(rig: Rig, nodes: Sequence[int], values: FloatArray | None, names: Sequence[str] = ()) -> ForceModel:
    """Return the model of a record: network given by ``values``, or free under ``names``."""
    return ForceModel.build(
        (lambda v: network(rig, v)) if values is None else network(rig, values),
        nodes,
        KERNEL,
        observation=np.eye(3),
        noise_std_K=np.full(3, NOISE_K),
        prior_mean_K=rig.blocks[0],
        prior_std_K=0.01,
        network_names=names,
        drift_K2_per_s=0.0 if nodes else DRIFT_K2_PER_S,
    )


def open_loop(rig: Rig, values: FloatArray, curves: Sequence[ForcePolynomial]) -> FloatArray:
    """Roll the network out from the first sample, never corrected; midpoint rule, 20 s against 450 s and slower."""
    plant = network(rig, values)
    jacobian, capacity = np.real(plant.jacobian_per_s[0]), np.real(plant.capacity_J_per_K[0])
    state, out = rig.blocks[0].copy(), [rig.blocks[0]]
    for k, step in enumerate(np.diff(rig.time_s)):
        start, end = np.real(plant.constant_K_per_s[k])
        ambient = np.array(rig.ambient[k])

        def rate(x: FloatArray, constant: FloatArray, ambient: FloatArray = ambient) -> FloatArray:
            heat = [float(c.heat_W(np.array(t), ambient)) for t, c in zip(x, curves, strict=False)]
            return jacobian @ x + constant + np.array(heat or [0.0]) / capacity

        middle = state + 0.5 * step * rate(state, start)
        state = state + step * rate(middle, 0.5 * (start + end))
        out.append(state)
    return np.array(out)


def fit_network(rig: Rig, start: dict[str, float]) -> FloatArray:
    """Fit the network's parameters to a record without latent force, by maximum likelihood."""
    return fit_map(model(rig, (), None, tuple(start)), rig.blocks, {}, start).values


def _rms(rig: Rig, path: FloatArray) -> FloatArray:
    return np.sqrt(np.mean((path - rig.blocks) ** 2, axis=0))


def run_cases(rig: Rig, hours: Sequence[float]) -> list[Case]:
    """Train every network on the first hours and test on what follows; the paper's 8 hours also on themselves."""
    cases = []
    for train_h in hours:
        cut = int(train_h * 3600.0 / 20.0)
        train, rest = rig.part(0, cut), rig.part(cut, rig.time_s.size)
        networks = {
            "published": np.array(list(PUBLISHED.values())),
            "conductances fitted": fit_network(train, PUBLISHED),
            "conductances and capacities fitted": fit_network(train, {**PUBLISHED, **CAPACITIES}),
        }
        for name, values in networks.items():
            plant = model(train, (0, 1, 2), values)
            fit = fit_map(plant, train.blocks, PRIORS, {"std": (0.1, 1.0), "length_s": (300.0, 3000.0)})
            force = smooth_force(plant, train.blocks, fit.values)
            learned = learn_heat_flow(
                plant, train.blocks, fit.values, force, boundary_K=train.ambient, vanishing=False, max_degree=3
            )
            for where, part in (("rest", rest), ("same hours", train)) if train_h == 8.0 else (("rest", rest),):
                bare, curved = (open_loop(part, values, curves) for curves in ((), learned.polynomials))
                told = [c.predict(curved[:, k], part.ambient).outside for k, c in enumerate(learned.polynomials)]
                errors = _rms(part, bare), _rms(part, curved)
                cases.append(
                    Case(name, train_h, where, *errors, float(np.mean(told)), learned, fit.named()["std"], values)
                )
    return cases


def joint_fit(rig: Rig, train_h: float) -> tuple[MapFit, MapFit]:
    """Fit conductances alone, and conductances together with latent forces on all blocks: what do the data still tell?"""
    train = rig.part(0, int(train_h * 3600.0 / 20.0))
    alone = fit_map(model(train, (), None, tuple(PUBLISHED)), train.blocks, {}, PUBLISHED)
    start = {"std": 0.2, "length_s": 3000.0, **PUBLISHED}
    joint = fit_map(model(train, (0, 1, 2), None, tuple(PUBLISHED)), train.blocks, PRIORS, start)
    return alone, joint


def fit_everything(rig: Rig, train_h: float) -> MapFit:
    """Free capacities, conductances and forces at once."""
    train = rig.part(0, int(train_h * 3600.0 / 20.0))
    start = {"std": 0.2, "length_s": 3000.0, **PUBLISHED, **CAPACITIES}
    return fit_map(model(train, (0, 1, 2), None, (*PUBLISHED, *CAPACITIES)), train.blocks, PRIORS, start)
