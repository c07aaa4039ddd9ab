"""Capacities that change with temperature: warming at constant heat in closed form, and a cycle against SciPy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.helpers import at_named, conductive_spec, record_of
from twin_core.effects import REGISTRY, Effect
from twin_core.network.model import Network, build_network
from twin_core.network.spec import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout

C, POWER_W = 2.0e3, 10.0
NODE = {"node": "n0"}
MELTING = REGISTRY["latent_heat"](NODE, {"L_J": 3.0e4, "T_m_K": 300.0, "w_K": 1.5})
STIFFENING = REGISTRY["capacity_temperature"](NODE, {"kappa_per_K": 0.02}, {"T_ref_K": 295.0})


def network_with(effect: Effect) -> Network:
    power = {"kind": "power", "unit": "W"}
    spec = conductive_spec(1, [], channels={"Q": power}, loads=[{"channel": "Q", "node": "n0"}])
    return at_named(build_network(load_spec(spec), [effect]), {"C:n0": C})


def warmed(effect: Effect, heat_W: np.ndarray, time_s: np.ndarray, start_K: float) -> np.ndarray:
    network = network_with(effect)
    forcing = build_forcing(network, record_of(time_s, Q=heat_W), 5.0)
    path = rollout(network, network.parameters.values, np.array([start_K]), forcing)
    assert path.converged
    return path.at_samples(forcing.sample_step)[:, 0]


def test_melting_takes_up_its_latent_heat() -> None:
    """Energy: C (T - T_0) + L = Q t once all is melted."""
    time_s = 60.0 * np.arange(121)
    found = warmed(MELTING, np.full(121, POWER_W), time_s, 290.0)
    assert found[-1] > 310.0
    np.testing.assert_allclose(C * (found[-1] - 290.0) + 3.0e4, POWER_W * time_s[-1], rtol=1e-4)


def test_a_capacity_that_grows_takes_up_more() -> None:
    """Energy: C (x + kappa x^2 / 2) between two temperatures x = T - T_ref."""
    time_s = 60.0 * np.arange(121)
    found = warmed(STIFFENING, np.full(121, POWER_W), time_s, 290.0)
    x = found - 295.0
    stored = C * (x + 0.01 * x**2) - C * (-5.0 + 0.01 * 25.0)
    np.testing.assert_allclose(stored, POWER_W * time_s, rtol=1e-4, atol=0.1)


@pytest.mark.parametrize("effect", [MELTING, STIFFENING], ids=lambda e: e.name)
def test_a_cycle_is_that_of_scipy(effect: Effect) -> None:
    time_s = 60.0 * np.arange(200)
    heat = np.where(np.arange(200) % 80 < 40, POWER_W, -POWER_W)

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        extra = (
            3.0e4 * np.exp(-0.5 * ((x - 300.0) / 1.5) ** 2) / (1.5 * np.sqrt(2.0 * np.pi))
            if effect is MELTING
            else C * 0.02 * (x - 295.0)
        )
        return heat[min(int(t / 60.0), 199)] / (C + extra)

    found = warmed(effect, heat, time_s, 293.0)
    truth = solve_ivp(rate, (0.0, time_s[-1]), [293.0], t_eval=time_s, max_step=30.0, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found, truth.y[0], atol=5e-3)


@pytest.mark.parametrize("kappa", [-5.0, -0.1, 0.1, 5.0])
def test_a_capacity_stays_positive_whatever_the_temperature(kappa: float) -> None:
    network = network_with(STIFFENING.with_values({"kappa_per_K": kappa}))
    temperature = np.linspace(1.0, 4000.0, 5000)
    forcing = build_forcing(network, record_of(np.arange(2501.0), Q=0.0), 1.0)
    along = forcing.along(temperature[:, None], forcing.boundaries_flat_K(0, 2500), 0, 2500)
    part = network.capacities[0].evaluate(along, np.array([kappa, C]))
    assert (C + part.extra_J_per_K > 0.0).all()
