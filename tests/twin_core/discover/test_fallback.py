"""The heat without a name: what the search calls ``learned_heat_flow`` is what the latent force learns on its own.

Both see the same readings, by separate codes: the search by steps of its rollout, refitted on open-loop trajectories; the
latent force by exact steps, with a kernel and hyperparameters of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core._typing import no_progress
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import fit_network
from twin_core.closed_loop import corrected
from twin_core.discover import shortlist
from twin_core.discover.search import search
from twin_core.discover.trial import Trial
from twin_core.effects import REGISTRY
from twin_core.effects.learned_heat_flow import LearnedHeatFlow
from twin_core.gp.kernels import Matern
from twin_core.gp.polynomial import ForcePolynomial
from twin_core.latent_force.declared import fit_declared
from twin_core.latent_force.posterior import GammaPrior
from twin_core.latent_force.regression import learn_heat_flow
from twin_core.missing_heat.smoothed import NodeHeat, smooth_missing_heat
from twin_core.network.model import build_network
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.telemetry import Record

CAPACITY, CONDUCTANCE, LEAK, NOISE_K = (900.0, 1500.0), 2.0, 1.0, 0.05
TIMES = 60.0 * np.arange(160)
POWER = np.repeat(np.random.default_rng(0).uniform(0.0, 60.0, 8), 20)
SPEC = {
    "twin": "t",
    "boundaries": {"wall": {"channel": "T_w"}},
    "channels": {
        "T_a": {"kind": "temperature", "unit": "K"},
        "T_b": {"kind": "temperature", "unit": "K"},
        "T_w": {"kind": "temperature", "unit": "K"},
        "Q": {"kind": "power", "unit": "W"},
    },
    "nodes": [
        {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"value": CAPACITY[0]}},
        {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"value": CAPACITY[1]}},
    ],
    "conductors": [
        {"between": ["a", "b"], "conductance_W_per_K": {"value": CONDUCTANCE}},
        {"between": ["b", "wall"], "conductance_W_per_K": {"value": LEAK}},
    ],
    "loads": [{"channel": "Q", "node": "a"}],
}


@dataclass(frozen=True)
class World:
    """What is hidden: a wall's temperature over time, and a heat into b of its own temperature and the wall's."""

    wall_K: np.ndarray
    heat_W: Callable[[np.ndarray, np.ndarray], np.ndarray]
    where: dict[str, str]

    def readings_K(self) -> np.ndarray:
        """Return the readings by SciPy, inputs held, the wall linear over a step, (n_times, 2)."""
        out = [np.array([290.0, 290.0])]
        for k, power in enumerate(POWER[:-1]):

            def rates(t: float, x: np.ndarray, power: float = power, k: int = k) -> list[float]:
                exchange, wall = CONDUCTANCE * (x[1] - x[0]), np.interp(t, TIMES[k : k + 2], self.wall_K[k : k + 2])
                rest = float(self.heat_W(x[1], wall)) - exchange + LEAK * (wall - x[1])
                return [(power + exchange) / CAPACITY[0], rest / CAPACITY[1]]

            out.append(solve_ivp(rates, TIMES[k : k + 2], out[-1], rtol=1e-9, atol=1e-9).y[:, -1])
        return np.array(out) + NOISE_K * np.random.default_rng(1).normal(size=(TIMES.size, 2))


WORLDS = {
    "its own temperature": World(
        np.full(TIMES.size, 270.0), lambda t, _: 8.0 * (1.0 - 2.0 * ((t - 295.0) / 15.0) ** 2), {"node": "b"}
    ),
    "a difference to a moving wall": World(
        285.0 + 5.0 * np.sin(TIMES / 1500.0),
        lambda t, w: -0.1 * (t - w) - 0.04 * (t - w) ** 2,
        {"node": "b", "boundary": "wall"},
    ),
}


@dataclass(frozen=True)
class Found:
    world: World
    spec: TwinSpec
    record: Record
    model: CalibratedModel
    seen: NodeHeat

    @property
    def effect(self) -> LearnedHeatFlow:
        (effect,) = self.model.effects
        assert isinstance(effect, LearnedHeatFlow) and effect.where == self.world.where
        return effect

    @property
    def law(self) -> ForcePolynomial:
        """The finding as a polynomial with the covariance that it carries."""
        weights = np.array([self.effect.values[q.name] for q in self.effect.parameter_specs()])
        cov = np.reshape(self.effect.settings["covariance_W2"], (weights.size, weights.size))
        return ForcePolynomial(self.effect.basis, weights, cov)


@pytest.fixture(scope="module", params=WORLDS.values(), ids=WORLDS.keys())
def found(request: pytest.FixtureRequest) -> Found:
    """Return the search's finding where the vocabulary holds the fallback alone, so that no cousin gets its name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shortlist, "REGISTRY", {"learned_heat_flow": REGISTRY["learned_heat_flow"]})
        world: World = request.param
        spec, readings = load_spec(SPEC), world.readings_K()
        record = Record(TIMES, {"T_a": readings[:, 0], "T_b": readings[:, 1], "T_w": world.wall_K, "Q": POWER})
        fit, calibration = fit_network(spec, [record])
        base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
        state = search(base, false_alarm_rate=0.01, progress=no_progress)
        (seen,) = smooth_missing_heat(state).heats
        return Found(world, spec, record, corrected(base, state), seen)


def latent_law(found: Found) -> ForcePolynomial:
    """Return what the latent force alone learns from the same record: own kernel, own hyperparameters, own steps."""
    network = build_network(found.spec)
    readings = np.column_stack([found.record.values[name] for name in ("T_a", "T_b")])
    fit = fit_declared(
        network,
        build_forcing(network, found.record, 60.0),
        readings,
        ("b",),
        Matern(3),
        {"std": GammaPrior(2.0, 0.2), "length_s": GammaPrior(3.0, 0.002)},
        {"std": 5.0, "length_s": 1000.0},
        noise_std_K=NOISE_K,
        prior_mean_K=readings[0],
        prior_std_K=5.0,
    )
    wall_K = found.world.wall_K if "boundary" in found.world.where else None
    (law,) = learn_heat_flow(fit.model, readings, fit.fit.values, fit.force, boundary_K=wall_K).polynomials
    return law


def test_search_and_latent_force_learn_the_same_heat(found: Found) -> None:
    """Same degree and form, same range; apart by less than two joint deviations where the record has been."""
    one, other = found.law, latent_law(found)
    assert (one.basis.degree, one.basis.vanishing) == (other.basis.degree, other.basis.vanishing)
    assert (one.basis.degree, one.basis.vanishing) == (2, "boundary" in found.world.where)
    np.testing.assert_allclose(
        [*one.basis.low_K, *one.basis.high_K], [*other.basis.low_K, *other.basis.high_K], atol=0.2
    )
    visited, wall = found.record.values["T_b"], found.record.values["T_w"]
    boundary = (wall,) if one.basis.has_boundary else ()
    a, b = one.predict(visited, *boundary), other.predict(visited, *boundary)
    inside, truth = ~(a.outside | b.outside), found.world.heat_W(visited, wall)
    assert inside.mean() > 0.9
    assert (np.abs(a.mean_W - b.mean_W) < 2.0 * np.hypot(a.std_W, b.std_W))[inside].all()
    for law in (a, b):
        assert (np.abs(law.mean_W - truth) < 3.5 * law.std_W)[inside].all()
        assert law.std_W[inside].max() < 0.05 * np.ptp(truth)


def test_the_witness_agrees_with_the_fallback(found: Found) -> None:
    assert found.seen.agrees
    if "boundary" not in found.world.where:
        law, visited = found.seen.law, np.linspace(*found.law.basis.low_K, *found.law.basis.high_K, 25)
        assert law is not None
        a, b = found.law.predict(visited), law.predict(visited)
        assert (np.abs(a.mean_W - b.mean_W) < 2.0 * np.hypot(a.std_W, b.std_W)).all()


def test_a_model_with_the_fallback_survives_its_file(found: Found) -> None:
    """Range and covariance of the coefficients are what a forecast needs to know its limits."""
    again = CalibratedModel.from_json(found.model.to_json())
    assert again.effects == found.model.effects and again.values == found.model.values
